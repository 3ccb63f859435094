"""95 % intervals of estimates, and the covariance of estimates whose errors are correlated."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from scipy.special import stdtrit
from torch import Tensor

from spelgen.listing import Listing

QUANTILE = 1.96
"""Half of a 95 % interval of a normal distribution, in standard deviations."""
# Number of contiguous blocks of samples of a jackknife. More blocks would be shorter than the correlation time of the
# errors, and fewer would not determine a covariance.
BLOCKS = 10
# Smallest number of samples of a block: half a second.
MIN_BLOCK = 25
DETERMINED = ("firm", "fair", "weak", "may be zero")


@dataclass(frozen=True)
class Interval:
    """Estimate of a quantity with its standard deviation; the interval of a positive quantity is cut at zero."""

    name: str
    value: float
    std: float
    unit: str = ""
    positive: bool = False

    @property
    def half(self) -> float:
        """Half the width of the 95 % interval."""
        return QUANTILE * self.std

    @property
    def low(self) -> float:
        """Lower end of the 95 % interval."""
        low = self.value - self.half
        return max(low, 0.0) if self.positive else low

    @property
    def high(self) -> float:
        """Upper end of the 95 % interval."""
        return self.value + self.half

    @property
    def determined(self) -> str:
        """Precision, the standard deviation relative to the value: ``firm``, ``fair``, ``weak`` or ``may be zero``."""
        for word, limit in zip(DETERMINED, (0.05, 0.2, 1.0), strict=False):
            if self.std <= limit * abs(self.value):
                return word
        return DETERMINED[-1]

    @property
    def text(self) -> str:
        """Value and half interval, as in ``1.234 ± 0.056``."""
        return f"{self.value:.4g} ± {self.half:.2g}"

    def to_dict(self) -> dict[str, object]:
        """Return the estimate in its JSON form."""
        numbers = {"value": self.value, "deviation": self.std, "low": self.low, "high": self.high}
        finite = {
            name: x if math.isfinite(x) else None for name, x in numbers.items()
        }  # JSON has no infinity
        return {"name": self.name, "unit": self.unit, **finite, "determined": self.determined}


def base_unit(name: str) -> str:
    """Return the unit of a base parameter of bodies, by the letter of its first parameter; "" for others."""
    return {"m": "kg", "h": "kg m", "I": "kg m²"}.get(name[0], "kg m²" if name.startswith("armature") else "")


def interval_listing(title: str, intervals: Sequence[Interval], note: str = "") -> Listing:
    """Return a table of estimates with half of their 95 % intervals."""
    rows = [(x.name, f"{x.value:.5g}", f"{x.half:.2g}", x.determined) for x in intervals]
    return Listing(title, ("parameter", "value", "+-", "determined"), tuple(rows), note, left=(0, 3))


def student_scale(blocks: int) -> float:
    """Return the factor on standard deviations from a few blocks: 1.96 results are Student's 95 % interval."""
    return float(stdtrit(blocks - 1, 0.975)) / QUANTILE


def jackknife_covariance(curvature: Tensor, descent: Tensor, prior: Tensor) -> tuple[Tensor, Tensor]:
    """Return the Newton steps of a MAP estimate without each block, (B, k), and the covariance J + S^-1 P S^-1 (k, k).

    J is the jackknife covariance of these steps, S the Hessian of all blocks and of the prior. Errors may be correlated
    within blocks, and may differ between them (Cameron and Miller, J. Human Resources 50:317, 2015, CV3).

    Args:
        curvature, descent: normal equations of B blocks, (B, k, k) and (B, k); descent and the gradient of the prior
            add up to zero.
        prior: precision P of the prior, (k, k).
    """
    count, hessian = len(curvature), curvature.sum(dim=0) + prior
    # the gradient without a block is minus the gradient of the block
    steps = torch.linalg.solve(hessian - curvature, -descent.unsqueeze(-1)).squeeze(-1)
    centred, inverse = steps - steps.mean(dim=0), torch.linalg.inv(hessian)
    return steps, (count - 1) / count * centred.mT @ centred + inverse @ prior @ inverse


def larger_covariance(covariance: Tensor, lower_bound: Tensor) -> Tensor:
    """Return a covariance (k, k) that is at least `lower_bound` (k, k), positive definite, in every direction.

    In coordinates in which the bound is the identity, eigenvalues of the covariance below one become one.
    """
    scale = lower_bound.diagonal().sqrt()  # parameters have different units
    # the bound of samples without noise is singular to rounding
    variances, axes = torch.linalg.eigh(lower_bound / scale.outer(scale))
    deviations = variances.clamp(min=1e-12).sqrt()
    root, inverse = scale.unsqueeze(-1) * axes * deviations, (axes / deviations / scale.unsqueeze(-1)).mT
    relative = inverse @ covariance @ inverse.mT
    values, vectors = torch.linalg.eigh((relative + relative.mT) / 2)
    scaled: Tensor = root @ vectors * values.clamp(min=1.0).sqrt()
    return scaled @ scaled.mT
