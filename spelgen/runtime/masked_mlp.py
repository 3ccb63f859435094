"""A tanh network whose outputs read their own joints only, with its derivatives written out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.joints import vector
from spelgen.runtime.parts import Intermediates, Layers, Rows, Units


def joint_masks(sensitivity: Rows, layers: Sequence[Units]) -> Iterator[Tensor]:
    """Yield what scales each layer's weights, (units, units below): 0 where one below reads more joints."""
    below = [{joint} for row in sensitivity for joint in range(len(row))]
    scale = torch.cat([vector(row) for row in sensitivity])
    for groups in layers:
        units = [set(joints) for joints, count in groups for _ in range(count)]
        yield scale * torch.stack([vector(lower <= unit for lower in below) for unit in units])
        below, scale = units, torch.ones(len(units), dtype=torch.float64)


class MaskedMLP(nn.Module):
    """A tanh network of ``depth`` hidden layers; units have no path to a joint they must not depend on.

    It reads a row of numbers for all joints, then the next row; ``sensitivity`` scales each of them.
    """

    def __init__(
        self, generator: torch.Generator, sensitivity: Rows, hidden: Units, outputs: Units, depth: int = 2
    ) -> None:
        super().__init__()
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for index, mask in enumerate(joint_masks(sensitivity, [hidden] * depth + [outputs])):
            weight = torch.randn(mask.shape, dtype=torch.float64, generator=generator)
            readable = (mask != 0).double().sum(dim=1, keepdim=True)
            self.weights.append(nn.Parameter(weight / readable.sqrt()))
            self.biases.append(nn.Parameter(torch.zeros(len(mask), dtype=torch.float64)))
            self.register_buffer(f"mask{index}", mask)
        nn.init.zeros_(self.weights[-1])  # so that nothing is learned yet

    def prepare(self, output_map: Tensor, offset: Tensor) -> Layers:
        """Return the masked weights, for offset + output_map y in place of y."""
        weights = [weight * self.get_buffer(f"mask{index}") for index, weight in enumerate(self.weights)]
        biases = list(self.biases)
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
