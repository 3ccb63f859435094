"""D(q, qd) = L L^T of a network: a full matrix over all axes of every joint."""

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
        self.speed, self.nominal = nn.Buffer(vector(joints.speed)), nn.Buffer(vector(joints.friction))
        rows = axes * len(joints.speed)
        row, column = torch.tril_indices(rows, rows)
        # spreads the numbers of a lower triangle, row by row, over a matrix: (rows, rows, numbers)
        spread = torch.eye(rows * rows).double()[:, rows * row + column].reshape(rows, rows, -1)
        self.entries = nn.Buffer(spread[axes - 1 :: axes])
        self.start = nn.Buffer(FACTOR_START * torch.eye(rows).double()[axes - 1 :: axes])
        self.network = network

    def prepare(self) -> Layers:
        """Return the network's weights made ready for many states, for the rows of L."""
        size = torch.sqrt(self.nominal / self.speed).unsqueeze(-1)
        output_map = (size.unsqueeze(-1) * self.entries).flatten(0, 1)
        return self.network.prepare(output_map, (size * self.start).flatten())

    def forward(self, encoded: Tensor, qd: Tensor, layers: Layers, right: Tensor) -> Tensor:
        """Return D(q, qd) right, (..., n, k)."""
        rows = self.network.forward(torch.cat([encoded, qd / self.speed], dim=-1), layers)[0]
        factor = rows.reshape(*qd.shape[:-1], *self.start.shape)
        return factor @ (factor.mT @ right)
