"""Bristles: what friction remembers of the way a joint came."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn


class Bristles(nn.Module):
    """K elements a joint, elastic up to their reach, sliding beyond; z is (..., n, K) [rad, m].

    z' = qd, and zero where |z| is the reach and would grow (Maxwell-slip elements: Lampaert, Al-Bender
    and Swevers, A Generalized Maxwell-Slip Friction Model, 2003). What turns around within the reach
    closes its loop, so a joint that stiction stops does not creep where its load oscillates.
    """

    reach: Tensor  # (n, K), a joint's shortest first

    def __init__(self, reach: Sequence[Sequence[float]]) -> None:
        super().__init__()
        self.register_buffer("reach", torch.tensor(reach, dtype=torch.float64))

    def rate(self, qd: Tensor, z: Tensor) -> Tensor:
        """z', (..., n, K)."""
        qd = qd.unsqueeze(-1)
        return qd * (qd.sign() * z < self.reach)

    def moved(self, z: Tensor, displacement: Tensor) -> Tensor:
        """z after joints went one way by (..., n), exactly."""
        return moved_bristles(z, displacement.unsqueeze(-1), self.reach)


def moved_bristles(z: Tensor, displacement: Tensor, reach: Tensor) -> Tensor:
    """z after joints went one way by a displacement, exactly; shapes as z, or broadcast to it."""
    return (z + displacement).clamp(-reach, reach)
