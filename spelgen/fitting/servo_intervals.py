"""How sure weights are after a fit of servos, by leaving out one window after the other.

Errors of neighbouring samples are alike, and none is what the noise of an encoder would be: so what a window says is
taken as one observation (the jackknife of a weighted least squares; one step without each window, see Cameron and
Miller, J. Human Resources 50:317, 2015, CV3). What windows do not tell stays as unsure as the prior.
"""

from __future__ import annotations

import torch

from spelgen.fitting.servo_descent import Normal


def covariance(normal: Normal, precision: torch.Tensor, halved: torch.Tensor) -> torch.Tensor:
    """Of the unknowns, (k, k): S^-1 (B + P) S^-1, of which the jackknife gives the first term, P is the prior's; and
    as much as they went when steps were halved.
    """
    count, prior = len(normal.matrix), torch.diag(precision)
    whole = normal.matrix.sum(dim=0) + prior
    # where the fit ended, the slopes of all windows and of the prior add up to nothing
    moved = torch.linalg.solve(whole - normal.matrix, normal.target.unsqueeze(-1)).squeeze(-1)
    moved = moved - moved.mean(dim=0)
    inverse = torch.linalg.inv(whole)
    jackknife = (count - 1) / count * moved.mT @ moved
    return jackknife + inverse @ prior @ inverse + torch.outer(halved, halved)
