"""Bristles: what friction remembers of the way a joint came."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from spelgen.runtime.parts import Rows


class Bristles(nn.Module):
    """K elements a joint, elastic up to their reach, sliding beyond; z is (..., n, K) [rad, m].

    z' = qd, and zero where |z| is the reach and would grow (Maxwell-slip elements: Lampaert, Al-Bender
    and Swevers, A Generalized Maxwell-Slip Friction Model, 2003). What turns around within the reach
    closes its loop, so a joint that stiction stops does not creep where its load oscillates.
    """

    def __init__(self, reach: Rows) -> None:
        super().__init__()
        # (n, K), a joint's shortest first
        self.reach = nn.Buffer(torch.tensor(reach, dtype=torch.float64))

    def rate(self, qd: Tensor, z: Tensor) -> Tensor:
        """z', (..., n, K)."""
        qd = qd.unsqueeze(-1)
        return qd * (qd.sign() * z < self.reach)


def moved_bristles(z: Tensor, displacement: Tensor, reach: Tensor) -> Tensor:
    """z after joints went one way by a displacement, exactly; shapes as z, or broadcast to it."""
    return (z + displacement).clamp(-reach, reach)
