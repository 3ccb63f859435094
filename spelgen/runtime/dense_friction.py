"""Friction D = L L^T of all q and qd: a network gives L."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from spelgen.runtime.joints import Joints, vector
from spelgen.runtime.parts import Layers, Network

FACTOR_START = 0.35  # diagonal of L, relative to the root of the joints' usual friction by speed


class DenseFriction(nn.Module):
    """D(q, qd) = L L^T, with ``axes`` rows of L for each joint.

    A joint moves along the last of its axes alone, so only those rows of L are worked out.
    """

    def __init__(self, joints: Joints, network: Network, axes: int) -> None:
        super().__init__()
        rows = axes * joints.n
        self.speed = nn.Buffer(vector(joints.speed))
        self.nominal = nn.Buffer(vector(joints.friction))
        moving = slice(axes - 1, None, axes)
        row, column = torch.tril_indices(rows, rows)
        # spreads the numbers of a lower triangle, row by row, over a matrix: (rows, rows, numbers)
        spread = torch.zeros(rows, rows, len(row), dtype=torch.float64)
        spread[row, column, torch.arange(len(row))] = 1.0
        self.entries = nn.Buffer(spread[moving])
        self.start = nn.Buffer(FACTOR_START * torch.eye(rows).double()[moving])
        self.network = network

    def prepare(self) -> Layers:
        """The network's weights made ready for many states."""
        size = torch.sqrt(self.nominal / self.speed).unsqueeze(-1)
        output_map = (size.unsqueeze(-1) * self.entries).flatten(0, 1)
        return self.network.prepare(output_map, (size * self.start).flatten())

    def _factor(self, encoded: Tensor, qd: Tensor, layers: Layers) -> Tensor:
        rows = self.network.forward(torch.cat([encoded, qd / self.speed], dim=-1), layers)[0]
        return rows.reshape(*qd.shape[:-1], *self.start.shape)

    def forward(self, encoded: Tensor, qd: Tensor, layers: Layers) -> Tensor:
        """The friction torque D qd, (..., n) [Nm, N]."""
        factor = self._factor(encoded, qd, layers)
        return (factor @ (factor.mT @ qd.unsqueeze(-1))).squeeze(-1)

    def dissipation(self, encoded: Tensor, qd: Tensor, layers: Layers) -> Tensor:
        """D, (..., n, n)."""
        factor = self._factor(encoded, qd, layers)
        return factor @ factor.mT
