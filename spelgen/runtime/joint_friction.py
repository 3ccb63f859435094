"""Friction of each joint by its own q_i and qd_i: viscous, a constant, and dry, a network."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.joints import Joints, vector
from spelgen.runtime.parts import Layers

HIDDEN = 8  # units of a joint's network
POSITION_SENSITIVITY = 0.1  # of friction's networks, relative to velocity
SMOOTHING = 0.03  # below this fraction of its usual speed dry friction fades to zero, to start from
LEAST_SMOOTHING = 0.001  # and at the least


class JointFriction(nn.Module):
    """A diagonal D(q, qd), positive for all weights."""

    kinds = (
        ("raw_viscous", "sizes", "Nm s/rad, N s/m"),
        ("raw_smoothing", "velocities", "rad/s, m/s"),
    )

    def __init__(self, joints: Joints, generator: torch.Generator) -> None:
        super().__init__()
        n, inputs = joints.n, 4
        encoded = (2 if all(joints.revolute) else 3) * n
        matrix = torch.zeros(n, inputs, encoded + 2 * n, dtype=torch.float64)
        for i, revolute in enumerate(joints.revolute):
            cos, sin = (i, n + i) if revolute else (2 * n + i, 2 * n + i)
            matrix[i, 0, cos] = matrix[i, 1, sin] = POSITION_SENSITIVITY
            matrix[i, 2, i - 2 * n], matrix[i, 3, i - n] = 1 / joints.speed[i], 1.0
        # where the inputs of a joint's network stand, (joints, inputs, encoded + 2 n)
        self.matrix = nn.Buffer(matrix)
        self.speed = nn.Buffer(vector(joints.speed))
        self.nominal = nn.Buffer(vector(joints.friction))
        self.raw_smoothing = nn.Parameter(torch.zeros(n, dtype=torch.float64))
        self.raw_viscous = nn.Parameter(torch.full((n,), -2.0, dtype=torch.float64))
        shape = (n, inputs, HIDDEN)
        weight = torch.randn(shape, dtype=torch.float64, generator=generator)
        self.weight = nn.Parameter(weight / inputs**0.5)
        self.bias = nn.Parameter(torch.zeros(n, HIDDEN, dtype=torch.float64))
        self.out = nn.Parameter(torch.zeros(n, HIDDEN, dtype=torch.float64))
        self.offset = nn.Parameter(torch.full((n,), -2.0, dtype=torch.float64))

    def viscous(self) -> Tensor:
        """Torque per velocity, (n,) [Nm s/rad, N s/m]."""
        return self.nominal * F.softplus(self.raw_viscous) / self.speed

    def prepare(self) -> tuple[Layers, Tensor, Tensor]:
        """Return all joints' networks as one, viscous friction, and the smoothing velocity squared."""
        # block matrices are faster than a loop over joints
        hidden = (self.weight.mT @ self.matrix).flatten(0, 1), self.bias.flatten()
        identity = torch.eye(len(self.out), dtype=self.out.dtype, device=self.out.device)
        out = (identity.unsqueeze(-1) * self.out).flatten(1), self.offset
        # of the velocity at which dry friction has turned around
        smoothing = self.speed**2 * (LEAST_SMOOTHING**2 + (SMOOTHING * self.raw_smoothing.exp()) ** 2)
        return (hidden, out), self.viscous(), smoothing

    def forward(
        self, encoded: Tensor, qd: Tensor, prepared: tuple[Layers, Tensor, Tensor], right: Tensor
    ) -> Tensor:
        """Return D(q, qd) right, (..., n, k)."""
        (hidden, out), viscous, smoothing = prepared
        smooth_speed = torch.sqrt(qd * qd + smoothing)
        inputs = torch.cat([encoded, qd, qd / smooth_speed], dim=-1)
        # dry friction relative to its usual size
        dry = F.softplus(F.linear(torch.tanh(F.linear(inputs, *hidden)), *out))
        return (viscous + self.nominal * dry / smooth_speed).unsqueeze(-1) * right
