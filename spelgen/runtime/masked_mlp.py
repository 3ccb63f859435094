"""A tanh network whose outputs depend on their own joints only, with explicit derivatives."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.hidden_units import joint_masks
from spelgen.runtime.parts import Intermediates, Layers, Rows
from spelgen.runtime.rows import Joint


class MaskedMLP(nn.Module):
    """A tanh network.

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
        masks = joint_masks(joints, scales, outputs, width, depth, min_units)
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for index, mask in enumerate(masks):
            weight = torch.randn(mask.shape, dtype=torch.float64, generator=generator)
            readable = (mask != 0).double().sum(dim=1, keepdim=True)
            self.weights.append(nn.Parameter(weight / readable.sqrt()))
            self.biases.append(nn.Parameter(torch.zeros(len(mask), dtype=torch.float64)))
            self.register_buffer(f"mask{index}", mask)
        nn.init.zeros_(self.weights[-1])  # so that the outputs start at zero

    def prepare(self, output_map: Tensor, offset: Tensor) -> Layers:
        """Return the masked layers of offset (rows,) + output_map (rows, outputs) y."""
        weights = [weight * self.get_buffer(f"mask{index}") for index, weight in enumerate(self.weights)]
        biases = list(self.biases)
        weights[-1], biases[-1] = output_map @ weights[-1], offset + output_map @ biases[-1]
        return tuple(zip(weights, biases, strict=True))

    def forward(self, encoded: Tensor, layers: Layers) -> tuple[Tensor, Intermediates]:
        """Return offset + output_map y, (..., rows), and the intermediates of ``vjp`` and ``jvp``."""
        layer, hidden = encoded, []
        for weight, bias in layers[:-1]:
            layer = torch.tanh(F.linear(layer, weight, bias))
            hidden.append(layer)
        return F.linear(layer, *layers[-1]), (hidden, layers)

    def vjp(self, intermediates: Intermediates, cotangent: Tensor) -> Tensor:
        """Return cotangent, (..., rows), times d/d encoded, by a reverse sweep; (..., inputs)."""
        hidden, layers = intermediates
        layer: Tensor = cotangent @ layers[-1][0]
        for (weight, _), value in zip(reversed(layers[:-1]), reversed(hidden), strict=True):
            # layer * (1 - value^2) in one operation
            layer = torch.ops.aten.tanh_backward(layer, value) @ weight
        return layer

    def jvp(self, intermediates: Intermediates, tangent: Tensor) -> Tensor:
        """Return d/d encoded times a tangent, by a forward sweep; (..., rows)."""
        hidden, layers = intermediates
        for (weight, _), value in zip(layers[:-1], hidden, strict=True):
            tangent = torch.ops.aten.tanh_backward(F.linear(tangent, weight), value)
        return F.linear(tangent, layers[-1][0])
