"""Joint positions as the numbers that networks read, with derivatives written out."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from spelgen.runtime.joints import Joints, vector


class JointEncoding(nn.Module):
    """Two numbers a joint, (..., 2 n): all cos q, then all sin q; if prismatic the scaled q, and zero."""

    def __init__(self, joints: Joints) -> None:
        super().__init__()
        self.revolute, self.center = nn.Buffer(vector(joints.revolute)), nn.Buffer(vector(joints.center))
        self.slope = nn.Buffer((1 - self.revolute) / vector(joints.reach))  # of the scaled q

    def forward(self, q: Tensor) -> Tensor:
        """Return the encoding of q."""
        scaled = self.slope * (q - self.center)
        return torch.cat([torch.addcmul(scaled, self.revolute, q.cos()), self.revolute * q.sin()], dim=-1)

    def jvp(self, encoded: Tensor, qd: Tensor) -> Tensor:
        """Return how fast the encoding changes along qd."""
        first, second = encoded.chunk(2, dim=-1)
        return torch.cat([(self.slope - second) * qd, self.revolute * first * qd], dim=-1)

    def vjp(self, encoded: Tensor, cotangent: Tensor) -> Tensor:
        """Return d/dq, (..., n), of what has the derivative ``cotangent`` by the encoding."""
        first, second = encoded.chunk(2, dim=-1)
        by_first, by_second = cotangent.chunk(2, dim=-1)
        return by_first * (self.slope - second) + by_second * self.revolute * first
