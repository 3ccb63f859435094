"""Bristles: what friction remembers of the way a joint came."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn


class Bristles(nn.Module):
    """K elements a joint, elastic up to their reach, sliding beyond; z is (..., n, K) [rad, m].

    z' = qd - |qd| z / reach, whatever the speed: in displacement it is linear, and needs no small
    steps (Dahl, A Solid Friction Model, 1968; several elements as in Lampaert, Al-Bender and
    Swevers, A Generalized Maxwell-Slip Friction Model, 2003).
    """

    reach: Tensor  # (n, K)

    def __init__(self, reach: Sequence[Sequence[float]]) -> None:
        super().__init__()
        self.register_buffer("reach", torch.tensor(reach, dtype=torch.float64))

    def slope(self, qd: Tensor, z: Tensor) -> Tensor:
        """dz/dq, (..., n, K), from 0 to 2, of joints that go the way of qd."""
        return 1 - qd.sign().unsqueeze(-1) * z / self.reach

    def rate(self, qd: Tensor, z: Tensor) -> Tensor:
        """z', (..., n, K)."""
        return qd.unsqueeze(-1) * self.slope(qd, z)

    def moved(self, z: Tensor, displacement: Tensor) -> Tensor:
        """z after joints went one way by (..., n), exactly."""
        return moved_bristles(z, displacement, self.reach)


def moved_bristles(z: Tensor, displacement: Tensor, reach: Tensor) -> Tensor:
    """z, (..., n, K), after joints went one way by (..., n), exactly."""
    end = displacement.sign().unsqueeze(-1) * reach
    # to all digits of small displacements
    return z + (z - end) * (-displacement.abs().unsqueeze(-1) / reach).expm1()
