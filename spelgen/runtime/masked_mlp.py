"""A tanh network whose outputs read their own joints only, with its derivatives written out."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.encoding import NetworkInput, joint_mask
from spelgen.runtime.parts import Intermediates, Layers, Units


class MaskedMLP(nn.Module):
    """A tanh network.

    ``layers`` names, unit by unit, the joints that each layer's units may read; weights between
    others are masked, so that a unit has no path to a joint it must not depend on.
    """

    def __init__(self, inputs: NetworkInput, layers: Sequence[Units], generator: torch.Generator) -> None:
        super().__init__()
        self.matrix, self.offset = nn.Buffer(inputs.matrix), nn.Buffer(inputs.offset)
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        below: Units = [(joint,) for joint in inputs.joints]
        for index, units in enumerate(layers):
            mask = joint_mask(units, below)
            weight = torch.randn(mask.shape, dtype=torch.float64, generator=generator)
            self.weights.append(nn.Parameter(weight / mask.sum(dim=1, keepdim=True).sqrt()))
            self.biases.append(nn.Parameter(torch.zeros(len(units), dtype=torch.float64)))
            self.register_buffer(f"mask{index}", mask * inputs.sensitivity if index == 0 else mask)
            below = units
        nn.init.zeros_(self.weights[-1])  # so that nothing is learned yet

    def prepare(self, output_map: Tensor, offset: Tensor) -> Layers:
        """Return the weights for the encoding as it is, and for offset + output_map y in place of y."""
        weights = [weight * self.get_buffer(f"mask{index}") for index, weight in enumerate(self.weights)]
        biases = list(self.biases)
        biases[0] = biases[0] + weights[0] @ self.offset
        weights[0] = weights[0] @ self.matrix
        weights[-1], biases[-1] = output_map @ weights[-1], offset + output_map @ biases[-1]
        return tuple(zip(weights, biases, strict=True))

    def forward(self, encoded: Tensor, layers: Layers) -> tuple[Tensor, Intermediates]:
        """Return offset + output_map y, (..., rows), and what ``vjp`` and ``jvp`` need."""
        layer, hidden = encoded, []
        for weight, bias in layers[:-1]:
            layer = torch.tanh(F.linear(layer, weight, bias))
            hidden.append(layer)
        return F.linear(layer, *layers[-1]), (hidden, layers)

    def vjp(self, intermediates: Intermediates, cotangent: Tensor) -> Tensor:
        """Return, by the reverse sweep, cotangent, (..., rows), times d/d encoded; (..., encoded)."""
        hidden, layers = intermediates
        layer: Tensor = cotangent @ layers[-1][0]
        for (weight, _), value in zip(reversed(layers[:-1]), reversed(hidden), strict=True):
            # layer * (1 - value^2) in one pass over memory
            layer = torch.ops.aten.tanh_backward(layer, value) @ weight
        return layer

    def jvp(self, intermediates: Intermediates, tangent: Tensor) -> Tensor:
        """Return, by the forward sweep, d/d encoded times the encoding's tangent; (..., rows)."""
        hidden, layers = intermediates
        for (weight, _), value in zip(layers[:-1], hidden, strict=True):
            tangent = torch.ops.aten.tanh_backward(F.linear(tangent, weight), value)
        return F.linear(tangent, layers[-1][0])
