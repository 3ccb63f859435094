"""Tell how sure parameters are after a fit of servos, by leaving out one stretch of the logs after the other.

Errors of neighbouring samples are alike, and those of one motion are: what a model lacks shows otherwise in another. So
what a log says is taken as one observation (the jackknife of a weighted least squares; one step without each log, see
Cameron and Miller, J. Human Resources 50:317, 2015, CV3). What logs do not determine stays as unsure as the prior.
"""

from __future__ import annotations

import torch

from spelgen.fitting.levenberg_marquardt import NormalEquations
from spelgen.settings.tuning.servo import ServoIntervalTuning

TUNING = ServoIntervalTuning()


def by_stretch(windows: NormalEquations, stretches: torch.Tensor) -> NormalEquations:
    """Return the sums of windows' normal equations (W, ...) over the stretches that these are of, (W,)."""

    def summed(terms: torch.Tensor) -> torch.Tensor:
        sums = terms.new_zeros(int(stretches.max()) + 1, *terms.shape[1:])
        return sums.index_add(0, stretches, terms)

    return NormalEquations(*map(summed, windows))


def covariance(windows: NormalEquations, precision: torch.Tensor, halved: torch.Tensor) -> torch.Tensor:
    """Return that of the unknowns, (k, k): S^-1 (B + P) S^-1, of which the jackknife gives the first term, P is the
    prior's; and as much as they changed when steps were halved (k,).
    """
    count, prior = len(windows.curvature), torch.diag(precision)
    total = windows.curvature.sum(dim=0) + prior
    # where the fit ended, the slopes of all windows and of the prior add up to nothing
    shifts = torch.linalg.solve(total - windows.curvature, -windows.descent.unsqueeze(-1)).squeeze(-1)
    shifts = shifts - shifts.mean(dim=0)
    inverse = torch.linalg.inv(total)
    jackknife = (count - 1) / count * shifts.mT @ shifts
    result: torch.Tensor = jackknife + inverse @ prior @ inverse + torch.outer(halved, halved)
    return result


def identifiable(windows: NormalEquations, precision: torch.Tensor, unknowns: torch.Tensor) -> torch.Tensor:
    """Return whether windows tell these unknowns (m,) from all others, by their variance inflation factors, (m,).

    Of joints that gravity does not load the slopes of errors by a dead zone and by dry friction are the same but for a
    factor, and what is linear in them says nothing of the one without the other.
    """
    curvature = windows.curvature.sum(dim=0)
    inverse = torch.linalg.inv(curvature + torch.diag(precision))
    inflation: torch.Tensor = (curvature.diagonal() * inverse.diagonal())[unknowns]
    return inflation < TUNING.variance_inflation
