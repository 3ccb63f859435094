"""95 % intervals of estimated parameters, and their covariance if the errors of samples are correlated."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from scipy.special import stdtrit
from torch import Tensor

from spelgen.listing import Listing

QUANTILE = 1.96
"""Half the width of the 95 % interval of a normal distribution, in standard deviations."""
# Number of contiguous blocks of samples in a jackknife. More blocks would be shorter than the correlation time of the
# errors, and fewer blocks would not determine a covariance.
BLOCKS = 10
# [1] Smallest number of samples of a jackknife block for fits with a prior, half a second at 50 Hz.
MIN_BLOCK = 25
DETERMINED = ("firm", "fair", "weak", "may be zero")
PRECISE = DETERMINED[:2]
"""Classes of intervals whose standard deviation is at most 20 % of the value."""


@dataclass(frozen=True)
class Interval:
    """Estimate of a quantity, with its standard deviation and its 95 % interval.

    positive: True for a quantity that cannot be negative, whose interval is cut at zero.
    """

    name: str
    value: float
    std: float
    unit: str = ""
    positive: bool = False

    @property
    def half(self) -> float:
        """Half the width of the 95 % interval of the quantity, in its unit."""
        return QUANTILE * self.std

    @property
    def low(self) -> float:
        """Lower end of the 95 % interval of the quantity, in its unit."""
        low = self.value - self.half
        return max(low, 0.0) if self.positive else low

    @property
    def high(self) -> float:
        """Upper end of the 95 % interval of the quantity, in its unit."""
        return self.value + self.half

    @property
    def determined(self) -> str:
        """Class of precision of the estimate: ``firm``, ``fair``, ``weak`` or ``may be zero``.

        The bounds of the first three classes are standard deviations of 5 %, 20 % and 100 % of the value.
        """
        for word, limit in zip(DETERMINED, (0.05, 0.2, 1.0), strict=False):
            if self.std <= limit * abs(self.value):
                return word
        return DETERMINED[-1]

    @property
    def rounded(self) -> float:
        """The estimate, rounded to the second digit of half the width of its interval."""
        if not 0 < self.half < math.inf:
            return self.value
        # Adding 0 turns -0 into 0.
        return round(self.value, 1 - int(f"{self.half:.1e}"[-3:])) + 0.0

    @property
    def text(self) -> str:
        """The estimate and half the width of its 95 % interval, as in ``1.234 ± 0.056``, with the same last digit."""
        return f"{self.rounded:.4g} ± {self.half:.2g}"

    def to_dict(self) -> dict[str, object]:
        """Return the estimate and its interval in JSON form."""
        numbers = {"value": self.value, "deviation": self.std, "low": self.low, "high": self.high}
        # infinite numbers become None, since JSON has no infinity
        finite = {name: x if math.isfinite(x) else None for name, x in numbers.items()}
        return {"name": self.name, "unit": self.unit, **finite, "determined": self.determined}


def base_unit(name: str) -> str:
    """Return the unit of a base parameter, from the first letters of its name; "" for friction parameters.

    Masses begin with m, first moments with h, inertias with I, rotor inertias with "armature".
    """
    return {"m": "kg", "h": "kg m", "I": "kg m²"}.get(name[0], "kg m²" if name.startswith("armature") else "")


def interval_listing(title: str, intervals: Sequence[Interval], note: str = "") -> Listing:
    """Return a table of estimates with half the widths of their 95 % intervals. note: text below the table."""
    if any(x.name.endswith("R") for x in intervals):
        note = f"R: includes parameters of other links that act only in this combination. {note}".strip()
    rows = [(x.name, f"{x.rounded:.5g}", f"{x.half:.2g}", x.determined) for x in intervals]
    return Listing(title, ("parameter", "value", "+-", "determined"), tuple(rows), note, left=(0, 3))


def student_scale(blocks: int) -> float:
    """Return the ratio of the 97.5 % quantiles of Student's t and normal distribution (two-sided 95 % intervals).

    Student's t distribution has ``blocks`` - 1 degrees of freedom. Standard deviations that are estimated from few
    blocks are multiplied by this ratio, so that 1.96 standard deviations are half the width of a 95 % interval.
    """
    return float(stdtrit(blocks - 1, 0.975)) / QUANTILE


def jackknife_covariance(curvature: Tensor, descent: Tensor, prior: Tensor) -> tuple[Tensor, Tensor]:
    """Return the steps of a block jackknife, and the covariance of a MAP estimate of k parameters.

    The first value (B, k) has, for each of the B blocks, the Newton step from the estimate to the estimate without this
    block. The second value (k, k) is the covariance V + S^-1 P S^-1, where V is the jackknife covariance of these
    steps, S is the Hessian of all blocks and the prior, and P is the precision of the prior. V is the error due to the
    blocks. The second term is the error due to the prior: an error e of the prior mean, with covariance P^-1, shifts
    the estimate by S^-1 P e. Errors of samples may be correlated within blocks, and their variance may differ between
    blocks (Cameron and Miller, J. Human Resources 50:317, 2015, CV3).

    Args:
        curvature: (B, k, k) Gauss-Newton Hessian of each block.
        descent: (B, k) negative gradient of each block's cost at the estimate. Because the total gradient is zero
            there, the sum of `descent` over the blocks is the gradient of the prior's negative log density.
        prior: (k, k) precision P of the prior.
    """
    count, hessian = len(curvature), curvature.sum(dim=0) + prior
    # the total gradient is zero at the estimate, so that the gradient without a block is minus the block's gradient
    steps = torch.linalg.solve(hessian - curvature, -descent.unsqueeze(-1)).squeeze(-1)
    centred, inverse = steps - steps.mean(dim=0), torch.linalg.inv(hessian)
    return steps, (count - 1) / count * centred.mT @ centred + inverse @ prior @ inverse


def larger_covariance(covariance: Tensor, lower_bound: Tensor) -> Tensor:
    """Return the covariance (k, k), enlarged so that its variance in each direction is not below `lower_bound`.

    In coordinates in which the lower bound is the identity, eigenvalues of the covariance below one become one. The
    lower bound must be positive definite.
    """
    # the matrix `lower_bound` is scaled to a unit diagonal, since parameters have different units
    scale = lower_bound.diagonal().sqrt()
    # The inverse of `lower_bound`, a covariance, is needed. Without noise in the samples, `lower_bound` is singular
    # except for rounding errors. The eigenvalues of the scaled matrix are therefore clamped.
    variances, axes = torch.linalg.eigh(lower_bound / scale.outer(scale))
    deviations = variances.clamp(min=1e-12).sqrt()
    root, inverse = scale.unsqueeze(-1) * axes * deviations, (axes / deviations / scale.unsqueeze(-1)).mT
    relative = inverse @ covariance @ inverse.mT
    values, vectors = torch.linalg.eigh((relative + relative.mT) / 2)
    scaled: Tensor = root @ vectors * values.clamp(min=1.0).sqrt()
    return scaled @ scaled.mT
