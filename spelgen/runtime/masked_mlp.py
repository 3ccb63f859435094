"""A tanh network whose outputs read their own joints only, with its derivatives written out."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.encoding import NetworkInput, Units, joint_mask
from spelgen.runtime.parts import Layers

MLPIntermediates = tuple[tuple[Tensor, ...], Layers]  # the hidden layers, and the weights


def sigmoid_vjp(cotangent: Tensor, value: Tensor) -> Tensor:
    """cotangent * value (1 - value), the sigmoid's derivative, in one pass over memory."""
    changed: Tensor = torch.ops.aten.sigmoid_backward(cotangent, value)
    return changed


class MaskedMLP(nn.Module):
    """A tanh network.

    ``layers`` names, unit by unit, the joints that each layer's units may read; weights between
    others are masked, so that a unit has no path to a joint it must not depend on.
    """

    def __init__(self, inputs: NetworkInput, layers: Sequence[Units], generator: torch.Generator) -> None:
        super().__init__()
        self.matrix = nn.Buffer(inputs.matrix)
        self.offset = nn.Buffer(inputs.offset)
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        below: Units = [(joint,) for joint in inputs.joints]
        for index, units in enumerate(layers):
            mask = joint_mask(units, below)
            weight = torch.randn(mask.shape, dtype=torch.float64, generator=generator)
            self.weights.append(nn.Parameter(weight / mask.sum(dim=1, keepdim=True).sqrt()))
            mask = mask * inputs.sensitivity if index == 0 else mask
            self.register_buffer(f"mask{index}", mask)
            self.biases.append(nn.Parameter(torch.zeros(len(units), dtype=torch.float64)))
            below = units
        nn.init.zeros_(self.weights[-1])  # so that nothing is learned yet

    def prepare(self, output_map: Tensor, offset: Tensor) -> Layers:
        """The weights for the encoding as it is, and for offset + output_map y in place of y.

        tanh x is computed as 2 sigmoid(2 x) - 1, whose slope takes one pass.
        """
        weights, biases = [], []
        for index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            weight = weight * self.get_buffer(f"mask{index}")
            if index == 0:
                bias, weight = bias + weight @ self.offset, weight @ self.matrix
            else:
                bias, weight = bias - weight.sum(dim=1), 2 * weight
            weights.append(2 * weight)
            biases.append(2 * bias)
        weights[-1] = 0.5 * output_map @ weights[-1]
        biases[-1] = offset + 0.5 * output_map @ biases[-1]
        return Layers(tuple(weights), tuple(biases))

    def forward(self, encoded: Tensor, layers: Layers) -> tuple[Tensor, MLPIntermediates]:
        """offset + output_map y, (..., rows); and what ``vjp`` and ``jvp`` need."""
        layer, hidden = encoded, []
        for weight, bias in zip(layers.weights[:-1], layers.biases, strict=False):
            layer = torch.sigmoid(F.linear(layer, weight, bias))
            hidden.append(layer)
        return F.linear(layer, layers.weights[-1], layers.biases[-1]), (tuple(hidden), layers)

    def vjp(self, intermediates: MLPIntermediates, cotangent: Tensor) -> Tensor:
        """The reverse sweep: cotangent, (..., rows), times d/d encoded; (..., encoded)."""
        hidden, layers = intermediates
        layer = cotangent @ layers.weights[-1]
        for weight, value in zip(reversed(layers.weights[:-1]), reversed(hidden), strict=True):
            layer = sigmoid_vjp(layer, value) @ weight
        return layer

    def jvp(self, intermediates: MLPIntermediates, tangent: Tensor) -> Tensor:
        """The forward sweep: d/d encoded times the encoding's tangent; (..., rows)."""
        hidden, layers = intermediates
        for weight, value in zip(layers.weights[:-1], hidden, strict=True):
            tangent = sigmoid_vjp(F.linear(tangent, weight), value)
        return F.linear(tangent, layers.weights[-1])
