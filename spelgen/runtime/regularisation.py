"""How a symmetric matrix of learned entries stays positive definite, without a branch on data."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class PositiveDefiniteBound(nn.Module):
    """Draws M towards a positive definite matrix C, as far as M needs it to be positive definite.

    M' = C + t (M - C), with t = 1 wherever M - margin C is positive definite. Elsewhere t = 2^-k is
    the first such power with t |M - C| <= 1 - margin, |.| being at least the norm relative to C:
    then M' - margin C is positive definite. t is constant in pieces, so that derivatives of M' are
    t times those of M. C has M's own zeros and linear relations, which therefore hold in M'.
    """

    def __init__(self, center: Tensor, margin: float) -> None:
        super().__init__()
        scale = center.diagonal().rsqrt()
        scaled = scale.unsqueeze(-1) * center * scale
        smallest = torch.linalg.eigvalsh(scaled)[0]
        self.center = nn.Buffer(center)  # C
        self.smallest = nn.Buffer(margin * center)  # margin C
        # an entry's largest part in the norm relative to C, divided by 1 - margin
        self.unit = nn.Buffer(scale.unsqueeze(-1) * scale / smallest / (1 - margin))

    def forward(self, mass: Tensor) -> tuple[Tensor, Tensor]:
        """M', (..., n, n), and t, (...)."""
        fixed = mass.detach()
        indefinite = torch.linalg.cholesky_ex(fixed - self.smallest).info != 0
        size = torch.linalg.vector_norm(self.unit * (fixed - self.center), dim=(-2, -1))
        fraction = torch.where(indefinite, torch.exp2(-torch.ceil(torch.log2(size)).clamp(min=1.0)), 1.0)
        return torch.lerp(self.center, mass, fraction[..., None, None]), fraction
