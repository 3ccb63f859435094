"""How a symmetric matrix of learned entries stays positive definite, without a branch on data."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class PositiveDefiniteShift(nn.Module):
    """Adds a multiple s >= 0 of a positive definite matrix C that makes M positive definite.

    s = 0 wherever S = M - margin C is positive definite. Elsewhere s = 2^k, the first power of two
    above 2 |S| / (least eigenvalue of C), both with C's diagonal scaled to one: s is constant in
    pieces, so that derivatives of M are derivatives of M + s C. C has M's own zeros and linear
    relations, which therefore hold in the sum.
    """

    matrix: Tensor  # C
    least: Tensor  # margin C
    unit: Tensor  # what scales C's diagonal to one, times 2 / least eigenvalue

    def __init__(self, matrix: Tensor, margin: float) -> None:
        super().__init__()
        scale = matrix.diagonal().rsqrt()
        scaled = scale.unsqueeze(-1) * matrix * scale
        least = torch.linalg.eigvalsh(scaled)[0]
        self.register_buffer("matrix", matrix)
        self.register_buffer("least", margin * matrix)
        self.register_buffer("unit", 2 / least * scale.unsqueeze(-1) * scale)

    def forward(self, mass: Tensor) -> Tensor:
        """M + s C, (..., n, n)."""
        excess = mass.detach() - self.least
        indefinite = torch.linalg.cholesky_ex(excess).info != 0
        size = torch.linalg.vector_norm(self.unit * excess, dim=(-2, -1))
        shift = torch.where(indefinite, torch.exp2(torch.ceil(torch.log2(size))), 0.0)
        return torch.addcmul(mass, shift[..., None, None], self.matrix)
