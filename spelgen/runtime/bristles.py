"""Bristles: what friction remembers of the way a joint came."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn


class Bristles(nn.Module):
    """K elements a joint, which stick up to their reach and slide beyond; z is (..., n, K) [rad, m].

    z' = qd, and zero where |z| is the reach and would grow (Maxwell-slip elements: Lampaert, Al-Bender and
    Swevers, A Generalized Maxwell-Slip Friction Model, 2003). Oscillations that turn around within the
    reach close their loops, so that a joint under load does not creep; z follows a displacement exactly,
    however long it is.
    """

    reach: Tensor  # (n, K)

    def __init__(self, reach: Sequence[Sequence[float]]) -> None:
        super().__init__()
        self.register_buffer("reach", torch.tensor(reach, dtype=torch.float64))

    def rate(self, qd: Tensor, z: Tensor) -> Tensor:
        """z', (..., n, K)."""
        velocity = qd.unsqueeze(-1)
        slides = velocity.sign() * z >= self.reach
        return torch.where(slides, 0.0, velocity)

    def moved(self, z: Tensor, displacement: Tensor) -> Tensor:
        """z after joints went one way by (..., n), exactly."""
        return moved_bristles(z, displacement, self.reach)


def moved_bristles(z: Tensor, displacement: Tensor, reach: Tensor) -> Tensor:
    """z, (..., n, K), after joints went one way by (..., n), exactly."""
    return (z + displacement.unsqueeze(-1)).clamp(-reach, reach)
