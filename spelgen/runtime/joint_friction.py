"""Friction of each joint by its own q_i and qd_i: viscous, a constant, and dry, a network."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.joints import Joints, vector
from spelgen.runtime.parts import Network, Prepared

SMOOTHING = 0.03  # below this fraction of its usual speed dry friction fades to zero, to start from
LEAST_SMOOTHING = 0.001  # and at the least


class JointFriction(nn.Module):
    """A diagonal D(q, qd), positive for all weights."""

    kinds = ("raw_viscous", "sizes", "Nm s/rad, N s/m"), ("raw_smoothing", "velocities", "rad/s, m/s")

    def __init__(self, joints: Joints, network: Network) -> None:
        super().__init__()
        self.speed, self.nominal = nn.Buffer(vector(joints.speed)), nn.Buffer(vector(joints.friction))
        self.raw_smoothing = nn.Parameter(torch.zeros_like(self.speed))
        self.raw_viscous = nn.Parameter(torch.full_like(self.speed, -2.0))
        self.network = network

    def viscous(self) -> Tensor:
        """Torque per velocity, (n,) [Nm s/rad, N s/m]."""
        return self.nominal * F.softplus(self.raw_viscous) / self.speed

    def prepare(self) -> Prepared:
        """Return the network's layers, viscous friction, and the smoothing velocity squared."""
        smoothing = self.speed**2 * (LEAST_SMOOTHING**2 + (SMOOTHING * self.raw_smoothing.exp()) ** 2)
        start = torch.full_like(self.speed, -2.0)
        return self.network.prepare(torch.diag(0 * start + 1), start), self.viscous(), smoothing

    def forward(self, encoded: Tensor, qd: Tensor, prepared: Prepared, right: Tensor) -> Tensor:
        """Return D(q, qd) right, (..., n, k)."""
        layers, viscous, smoothing = prepared
        smooth_speed = torch.sqrt(qd * qd + smoothing)
        inputs = torch.cat([encoded, qd, qd / smooth_speed], dim=-1)
        # dry friction relative to its usual size
        dry = F.softplus(self.network.forward(inputs, layers)[0])
        diagonal: Tensor = viscous + self.nominal * dry / smooth_speed
        return diagonal.unsqueeze(-1) * right
