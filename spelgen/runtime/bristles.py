"""Bristles: what friction remembers of the way a joint came."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

STICKING = 0.7  # of a bristle's reach: as far as it bends before it yields


class Bristles(nn.Module):
    """K elements a joint, elastic at first, sliding in the end; z is (..., n, K) [rad, m].

    z' = qd, but where |z| grows beyond STICKING reach, qd ((1 - |z| / reach) / (1 - STICKING))^2,
    whatever the speed. What is elastic closes its loops: a held joint does not creep (Dupont, Hayward,
    Armstrong and Altpeter, Single State Elastoplastic Friction Models, 2002). The square is Dahl's
    (A Solid Friction Model, 1968, with the exponent 2): the way has a solution of one division.
    """

    reach: Tensor  # (n, K)

    def __init__(self, reach: Sequence[Sequence[float]]) -> None:
        super().__init__()
        self.register_buffer("reach", torch.tensor(reach, dtype=torch.float64))

    def slope(self, qd: Tensor, z: Tensor) -> Tensor:
        """dz/dq, (..., n, K), from 0 to 1, of joints that go the way of qd."""
        bent = qd.sign().unsqueeze(-1) * z / self.reach
        return ((1 - bent) / (1 - STICKING)).clamp(max=1.0).square()

    def rate(self, qd: Tensor, z: Tensor) -> Tensor:
        """z', (..., n, K)."""
        return qd.unsqueeze(-1) * self.slope(qd, z)

    def moved(self, z: Tensor, displacement: Tensor) -> Tensor:
        """z after joints went one way by (..., n), exactly."""
        return moved_bristles(z, displacement, self.reach)


def moved_bristles(z: Tensor, displacement: Tensor, reach: Tensor) -> Tensor:
    """z, (..., n, K), after joints went one way by (..., n), exactly."""
    direction = displacement.sign().unsqueeze(-1)
    moved, bent = displacement.abs().unsqueeze(-1), direction * z
    elastic = torch.minimum(moved, (STICKING * reach - bent).clamp(min=0.0))
    unbent = reach - bent - elastic
    yielding = (moved - elastic) * unbent / ((1 - STICKING) * reach) ** 2
    # what is added to z stands alone: beside the reach small displacements would be lost
    return z + direction * (elastic + unbent * yielding / (1 + yielding))
