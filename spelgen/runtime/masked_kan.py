"""A Kolmogorov-Arnold network whose outputs depend on their own joints only, with explicit derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.hidden_units import joint_masks
from spelgen.runtime.parts import Intermediates, Layers, Rows
from spelgen.runtime.rows import Joint

GRID = 4  # bumps on an edge
SPACING = 2 / (GRID - 1)


class Bumps(NamedTuple):
    """The inputs of a layer relative to the grid, (..., inputs, GRID)."""

    distance: Tensor  # distance from each grid point, in grid spacings
    height: Tensor


class MaskedKAN(nn.Module):
    """A Kolmogorov-Arnold network.

    Each edge from an input to a unit has a learned function of its own: a sum of Gaussian bumps on
    a grid over [-1, 1] (Li, arXiv 2405.06721, in place of the splines of Liu et al., arXiv
    2404.19756). The initial functions are nearly linear with a random slope, because few samples do
    not smooth a wavy one. tanh keeps the outputs of a layer within the grid.

    Args:
        generator: of the initial weights; the last layer starts at zero.
        joints: of the arm.
        scales: a row (n,) of factors for each input per joint: cos q or the scaled q, sin q, and others.
        outputs: names of the joints that each output depends on; no unit has a path to another joint.
        width, depth: units of a hidden layer, and number of hidden layers.
        min_units: smallest number of units of a hidden layer for outputs that depend on the same joints.
    """

    def __init__(
        self,
        generator: torch.Generator,
        joints: Sequence[Joint],
        *,
        scales: Rows,
        outputs: Sequence[Sequence[str]],
        width: int = 64,
        depth: int = 2,
        min_units: int = 1,
    ) -> None:
        super().__init__()
        grid = torch.linspace(-1, 1, GRID, dtype=torch.float64)
        self.grid = nn.Buffer(grid / SPACING)
        masks = joint_masks(joints, scales, outputs, width, depth, min_units)
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for index, mask in enumerate(masks):
            edges = mask.unsqueeze(-1)
            slope = torch.randn(edges.shape, dtype=torch.float64, generator=generator)
            readable = (edges != 0).double().sum(dim=1, keepdim=True)
            self.weights.append(nn.Parameter(slope * grid / readable.sqrt()))
            self.biases.append(nn.Parameter(torch.zeros(len(mask), dtype=torch.float64)))
            self.register_buffer(f"mask{index}", edges)
        nn.init.zeros_(self.weights[-1])  # so that the outputs start at zero

    def prepare(self, output_map: Tensor, offset: Tensor) -> Layers:
        """Return the masked layers of offset (rows,) + output_map (rows, outputs) y."""
        weights = [(w * self.get_buffer(f"mask{i}")).flatten(1) for i, w in enumerate(self.weights)]
        biases = list(self.biases)
        weights[-1], biases[-1] = output_map @ weights[-1], offset + output_map @ biases[-1]
        return tuple(zip(weights, biases, strict=True))

    def _bumps(self, value: Tensor) -> Bumps:
        distance = (value / SPACING).unsqueeze(-1) - self.grid
        return Bumps(distance, torch.exp(-distance * distance))

    def forward(self, encoded: Tensor, layers: Layers) -> tuple[Tensor, Intermediates]:
        """Return offset + output_map y, (..., rows), and the intermediates of ``vjp`` and ``jvp``."""
        bumps, hidden = [self._bumps(encoded)], []
        for weight, bias in layers[:-1]:
            hidden.append(torch.tanh(F.linear(bumps[-1].height.flatten(-2), weight, bias)))
            bumps.append(self._bumps(hidden[-1]))
        return F.linear(bumps[-1].height.flatten(-2), *layers[-1]), (bumps, hidden, layers)

    def vjp(self, intermediates: Intermediates, cotangent: Tensor) -> Tensor:
        """Return cotangent, (..., rows), times d/d encoded, by a reverse sweep; (..., inputs)."""
        bumps, hidden, layers = intermediates
        layer = self._bumps_vjp(bumps[-1], cotangent @ layers[-1][0])
        for index in reversed(range(len(hidden))):
            layer = layer * (1 - hidden[index] * hidden[index])
            layer = self._bumps_vjp(bumps[index], layer @ layers[index][0])
        return layer

    def _bumps_vjp(self, bumps: Bumps, cotangent: Tensor) -> Tensor:
        cotangent = cotangent.reshape(*cotangent.shape[:-1], *bumps.distance.shape[-2:])
        return (-2 / SPACING) * (bumps.distance * bumps.height * cotangent).sum(dim=-1)

    def jvp(self, intermediates: Intermediates, tangent: Tensor) -> Tensor:
        """Return d/d encoded times a tangent, by a forward sweep; (..., rows)."""
        bumps, hidden, layers = intermediates
        for index, (weight, _) in enumerate(layers):
            slopes = bumps[index].distance * bumps[index].height
            tangent = F.linear((-2 / SPACING) * (slopes * tangent.unsqueeze(-1)).flatten(-2), weight)
            if index < len(hidden):
                tangent = tangent * (1 - hidden[index] * hidden[index])
        return tangent
