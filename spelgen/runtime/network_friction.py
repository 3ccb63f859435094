"""Friction from networks: of each joint as a function of its own q_i and qd_i, or a full matrix D(q, qd)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.parts import Layers, Network
from spelgen.runtime.rows import Joint, vector

# Initial velocity below which dry friction goes to zero, relative to the typical speed, and its lower bound.
SMOOTHING = 0.03
MIN_SMOOTHING = 0.001
# Initial diagonal of L, relative to the root of typical friction per typical speed.
INITIAL_FACTOR = 0.35


class JointFrictionParameters(NamedTuple):
    """All that depends on the parameters only."""

    layers: Layers
    viscous: Tensor  # (n,) [Nm s/rad, N s/m]
    smoothing: Tensor  # squared smoothing velocity, (n,)


class JointFriction(nn.Module):
    """A diagonal D(q, qd), positive for all parameters: viscous constants, and a network for dry friction."""

    parameter_groups = (
        ("raw_viscous", "sizes", "Nm s/rad, N s/m"),
        ("raw_smoothing", "velocities", "rad/s, m/s"),
    )

    def __init__(self, joints: Sequence[Joint], network: Network) -> None:
        super().__init__()
        self.speed = nn.Buffer(vector(joint.speed for joint in joints))
        self.nominal = nn.Buffer(vector(joint.friction for joint in joints))
        self.raw_smoothing = nn.Parameter(torch.zeros_like(self.speed))
        self.raw_viscous = nn.Parameter(torch.full_like(self.speed, -2.0))
        self.network = network

    def viscous(self) -> Tensor:
        """Return the viscous coefficients, (n,) [Nm s/rad, N s/m]."""
        return self.nominal * F.softplus(self.raw_viscous) / self.speed

    def prepare(self) -> JointFrictionParameters:
        """Return the parameter cache."""
        smoothing = self.speed**2 * (MIN_SMOOTHING**2 + (SMOOTHING * self.raw_smoothing.exp()) ** 2)
        start = torch.full_like(self.speed, -2.0)
        layers = self.network.prepare(torch.diag(0 * start + 1), start)
        return JointFrictionParameters(layers, self.viscous(), smoothing)

    def forward(
        self, encoded: Tensor, qd: Tensor, parameters: JointFrictionParameters, right: Tensor
    ) -> Tensor:
        """Return D(q, qd) right, (..., n, k)."""
        layers, viscous, smoothing = parameters
        smooth_speed = torch.sqrt(qd * qd + smoothing)
        inputs = torch.cat([encoded, qd, qd / smooth_speed], dim=-1)
        # dry friction relative to its typical magnitude
        dry = F.softplus(self.network.forward(inputs, layers)[0])
        diagonal: Tensor = viscous + self.nominal * dry / smooth_speed
        return diagonal.unsqueeze(-1) * right


class DenseFriction(nn.Module):
    """D(q, qd) = L L^T, with ``axes`` rows of L for each joint.

    A joint moves along the last of its axes only, so only those rows of L are computed.
    """

    def __init__(self, joints: Sequence[Joint], network: Network, axes: int) -> None:
        super().__init__()
        self.speed = nn.Buffer(vector(joint.speed for joint in joints))
        self.nominal = nn.Buffer(vector(joint.friction for joint in joints))
        rows = axes * len(joints)
        row, column = torch.tril_indices(rows, rows)
        # from the entries of a lower triangle, rows in sequence, to the matrix: (rows, rows, entries)
        spread = torch.eye(rows * rows).double()[:, rows * row + column].reshape(rows, rows, -1)
        self.entries = nn.Buffer(spread[axes - 1 :: axes])
        self.initial = nn.Buffer(INITIAL_FACTOR * torch.eye(rows).double()[axes - 1 :: axes])
        self.network = network

    def prepare(self) -> Layers:
        """Return the layers that give the rows of L."""
        size = torch.sqrt(self.nominal / self.speed).unsqueeze(-1)
        output_map = (size.unsqueeze(-1) * self.entries).flatten(0, 1)
        return self.network.prepare(output_map, (size * self.initial).flatten())

    def forward(self, encoded: Tensor, qd: Tensor, layers: Layers, right: Tensor) -> Tensor:
        """Return D(q, qd) right, (..., n, k)."""
        rows = self.network.forward(torch.cat([encoded, qd / self.speed], dim=-1), layers)[0]
        factor = rows.reshape(*qd.shape[:-1], *self.initial.shape)
        return factor @ (factor.mT @ right)
