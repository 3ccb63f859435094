"""A full matrix D(q, qd) = L L^T over all axes of every joint, from a network."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from spelgen.runtime.parts import Layers, Network
from spelgen.runtime.rows import Joint, vector

# Initial diagonal of L, relative to the root of typical friction per typical speed.
INITIAL_FACTOR = 0.35


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
