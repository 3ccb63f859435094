"""The encoding of joint positions that networks depend on, with explicit derivatives."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from spelgen.runtime.rows import Joint, vector


class JointEncoding(nn.Module):
    """Two numbers per joint, (..., 2 n): first cos q of all joints, then sin q; prismatic: scaled q, 0."""

    def __init__(self, joints: Sequence[Joint]) -> None:
        super().__init__()
        self.revolute = nn.Buffer(vector(joint.joint_type == "revolute" for joint in joints))
        self.center = nn.Buffer(vector(joint.center for joint in joints))
        # derivative of the scaled q with respect to q
        self.slope = nn.Buffer((1 - self.revolute) / vector(joint.half_range for joint in joints))

    def forward(self, q: Tensor) -> Tensor:
        """Return the encoding, (..., 2 n), of q (..., n) [rad, m]."""
        scaled = self.slope * (q - self.center)
        return torch.cat([torch.addcmul(scaled, self.revolute, q.cos()), self.revolute * q.sin()], dim=-1)

    def jvp(self, encoded: Tensor, qd: Tensor) -> Tensor:
        """Return the rate of the encoding, (..., 2 n), at the velocity qd."""
        first, second = encoded.chunk(2, dim=-1)
        return torch.cat([(self.slope - second) * qd, self.revolute * first * qd], dim=-1)

    def vjp(self, encoded: Tensor, cotangent: Tensor) -> Tensor:
        """Return the derivative with respect to q, (..., n), from that with respect to the encoding."""
        first, second = encoded.chunk(2, dim=-1)
        by_first, by_second = cotangent.chunk(2, dim=-1)
        return by_first * (self.slope - second) + by_second * self.revolute * first
