"""What stands beside rigid bodies as an ONNX graph, with its derivatives written out as in the runtime.

The networks of M and V go through their layers side by side: for one state a node costs more than its numbers.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from spelgen.exporting.description import Network, TrainedModel
from spelgen.exporting.onnx_graph import OnnxGraph
from spelgen.exporting.onnx_joint_functions import OnnxJointFunctions


class OnnxResiduals:
    """Residuals at q, (batch, n); None where the model has none of that kind."""

    def __init__(self, model: TrainedModel, graph: OnnxGraph, q: str) -> None:
        self.g, self.n, self._q, self._encoding = graph, model.n, q, model.residuals.encoding
        self._mass, self._potential = model.residuals.mass, model.residuals.potential
        self._functions = OnnxJointFunctions(model, graph, q)
        self._hidden = [each.weights[:-1] if each else () for each in (self._mass, self._potential)]
        self._weights = [self._side_by_side(k) for k in range(max(map(len, self._hidden)))]

    @property
    def friction_factor(self) -> str | None:
        """What friction is multiplied by, (batch, n)."""
        return self._functions.friction_factor

    def _units(self, layer: int) -> list[int]:
        """How many units of a hidden layer are M's, and how many V's."""
        return [len(weights[layer]) if layer < len(weights) else 0 for weights in self._hidden]

    def _side_by_side(self, layer: int) -> np.ndarray:
        """The weights of a hidden layer, (units, units below); both networks read the same encoding."""
        if layer == 0:
            return np.concatenate([weights[0] for weights in self._hidden if weights])
        above, below = self._units(layer), self._units(layer - 1)
        found = np.zeros((sum(above), sum(below)))
        for rows, columns, weights in zip(_parts(above), _parts(below), self._hidden, strict=True):
            if layer < len(weights):
                found[rows, columns] = weights[layer]
        return found

    def _last(self, network: Network) -> tuple[int, np.ndarray]:
        """A network's last hidden layer, and its rows by all units of that layer, (rows, units)."""
        layer, own = len(network.weights) - 2, 0 if network is self._mass else 1
        units = self._units(layer)
        found = np.zeros((len(network.weights[-1]), sum(units)))
        found[:, _parts(units)[own]] = network.weights[-1]
        return layer, found

    @cached_property
    def _encoded(self) -> str:
        """What networks read, (batch, 2 n) or (batch, 3 n)."""
        g, encoding, parts = self.g, self._encoding, [self.g.Cos(self._q), self.g.Sin(self._q)]
        if encoding.prismatic:
            parts.append(g.Mul(g.Sub(self._q, encoding.center), 1 / encoding.reach))
        found: str = g.Concat(*parts, axis=1)
        return found

    @cached_property
    def _slope(self) -> str:
        """Of the encoding by the joint that it reads, likewise."""
        zero, one = np.zeros((self.n, self.n)), np.eye(self.n)
        turned = np.block([[zero, one], [-one, zero]])
        if not self._encoding.prismatic:
            found: str = self.g.MatMul(self._encoded, turned)
            return found
        sliding = np.concatenate([np.zeros(2 * self.n), 1 / self._encoding.reach])
        found = self.g.Gemm(self._encoded, np.pad(turned, ((0, self.n), (0, self.n))), sliding)
        return found

    @property
    def _spread(self) -> np.ndarray:
        """From joints to what is read of them, (n, 2 n) or (n, 3 n)."""
        return np.tile(np.eye(self.n), 3 if self._encoding.prismatic else 2)

    @cached_property
    def _layers(self) -> list[str]:
        g, layer, found = self.g, self._encoded, []
        for k, weight in enumerate(self._weights):
            biases = [
                each.biases[k] for each in (self._mass, self._potential) if each and k < len(each.weights) - 1
            ]
            layer = g.Sigmoid(g.Gemm(layer, weight, np.concatenate(biases), transB=1))
            found.append(layer)
        return found

    @cached_property
    def _slopes(self) -> list[str]:
        g = self.g
        return [g.Sub(layer, g.Mul(layer, layer)) for layer in self._layers]

    @cached_property
    def mass(self) -> str | None:
        """What is added to M, (batch, n, n)."""
        if self._mass is None:
            return None
        layer, last = self._last(self._mass)
        rows = self.g.Gemm(self._layers[layer], last, self._mass.biases[-1], transB=1)
        return self.g.reshaped(rows, 0, self.n, self.n)

    @cached_property
    def gravity(self) -> list[str]:
        """Parts of dV/dq, (batch, n) each."""
        network = [] if self._potential is None else [self.g.Neg(self._pulled(None))]
        torque = self._functions.torque
        return network if torque is None else [*network, torque]

    def bias(self, qd: str) -> list[str]:
        """Parts of what holds qd steady, (batch, n) each: dR/dt qd - d/dq (1/2 qd^T R qd - V)."""
        if self._mass is None:
            return self.gravity
        g, n = self.g, self.n
        layer, last = self._last(self._mass)
        units = last.shape[1]
        # half of what each unit adds to R qd
        by_unit = last.reshape(n, n, units).transpose(1, 2, 0).reshape(n, units * n) / 2
        moved = g.reshaped(g.MatMul(qd, by_unit), 0, units, n)
        across = g.Transpose(moved, perm=[0, 2, 1])
        kinetic = g.reshaped(g.MatMul(g.reshaped(qd, 0, 1, n), across), 0, units)
        tangent = g.Mul(self._slope, g.MatMul(qd, 2 * self._spread))
        for weight, slope in zip(self._weights[: layer + 1], self._slopes, strict=False):
            tangent = g.Mul(g.MatMul(tangent, weight.T), slope)
        changing = g.reshaped(g.MatMul(g.reshaped(tangent, 0, 1, units), moved), 0, n)
        torque = self._functions.torque
        own = g.Sub(changing, self._pulled(kinetic))
        return [own] if torque is None else [own, torque]

    def _pulled(self, kinetic: str | None) -> str:
        """d/dq, (batch, n), of what has the derivative ``kinetic`` by M's last hidden layer, less V."""
        g, top = self.g, {}
        by: str | None = None
        if self._potential is not None:
            layer, last = self._last(self._potential)
            top[layer] = -last
        for k in reversed(range(len(self._weights))):
            if by is not None:
                passed = g.Mul(by, self._slopes[k + 1])
                by = g.Gemm(passed, self._weights[k + 1], *([top[k]] if k in top else []))
            elif k in top:
                by = g.constant(top[k])
            if kinetic is not None and self._mass is not None and k == len(self._mass.weights) - 2:
                by = kinetic if by is None else g.Add(by, kinetic)
        by_encoded = g.MatMul(g.Mul(by, self._slopes[0]), self._weights[0])
        found: str = g.MatMul(g.Mul(by_encoded, self._slope), self._spread.T)
        return found


def _parts(sizes: list[int]) -> list[slice]:
    ends = np.cumsum(sizes)
    return [slice(int(end) - size, int(end)) for end, size in zip(ends, sizes, strict=True)]
