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

    def rate(self, qd: Tensor, z: Tensor) -> Tensor:
        """z', (..., n, K)."""
        return qd.unsqueeze(-1) * bristle_slope(z, qd.unsqueeze(-1), self.reach)

    def moved(self, z: Tensor, displacement: Tensor) -> Tensor:
        """z after joints went one way by (..., n), exactly."""
        return moved_bristles(z, displacement.unsqueeze(-1), self.reach)


def bristle_slope(z: Tensor, qd: Tensor, reach: Tensor) -> Tensor:
    """dz/dq, from 0 to 2, of joints that go the way of qd; shapes as z, or broadcast to it."""
    return 1 - qd.sign() * z / reach


def moved_bristles(z: Tensor, displacement: Tensor, reach: Tensor) -> Tensor:
    """z after joints went one way by a displacement, exactly; shapes as z, or broadcast to it."""
    end = displacement.sign() * reach
    # to all digits of small displacements
    return z + (z - end) * (-displacement.abs() / reach).expm1()
