"""What stands beside rigid bodies as an ONNX graph, with its derivatives written out as in the runtime."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from spelgen.exporting.description import Harmonics, Network, Splines, TrainedModel
from spelgen.exporting.onnx_graph import OnnxGraph


@dataclass(frozen=True)
class _Pass:
    """A network's work at q: its rows (batch, rows), and by layer the slopes of its units."""

    rows: str
    slopes: tuple[str, ...]


class OnnxResiduals:
    """Residuals at q, (batch, n); None where the model has none of that kind."""

    def __init__(self, model: TrainedModel, graph: OnnxGraph, q: str) -> None:
        self.g, self.n, self._q = graph, model.n, q
        self._residuals = model.residuals

    @cached_property
    def _encoded(self) -> str:
        """What networks read, (batch, 2 n) or (batch, 3 n)."""
        g, encoding, parts = self.g, self._residuals.encoding, [self._cosine, self._sine]
        if encoding.prismatic:
            parts.append(g.Mul(g.Sub(self._q, encoding.center), 1 / encoding.reach))
        found: str = g.Concat(*parts, axis=1)
        return found

    @cached_property
    def _cosine(self) -> str:
        found: str = self.g.Cos(self._q)
        return found

    @cached_property
    def _sine(self) -> str:
        found: str = self.g.Sin(self._q)
        return found

    def _passed(self, network: Network) -> _Pass:
        g, layer, slopes = self.g, self._encoded, []
        for weight, bias in zip(network.weights[:-1], network.biases, strict=False):
            layer = g.Sigmoid(g.Gemm(layer, weight, bias, transB=1))
            slopes.append(g.Sub(layer, g.Mul(layer, layer)))
        rows = g.Gemm(layer, network.weights[-1], network.biases[-1], transB=1)
        return _Pass(rows, tuple(slopes))

    @cached_property
    def _mass(self) -> _Pass | None:
        network = self._residuals.mass
        return None if network is None else self._passed(network)

    @cached_property
    def mass(self) -> str | None:
        """What is added to M, (batch, n, n)."""
        return None if self._mass is None else self.g.reshaped(self._mass.rows, 0, self.n, self.n)

    def coriolis(self, qd: str) -> str | None:
        """dR/dt qd - d/dq (1/2 qd^T R qd), (batch, n), of what is added to M; qd: (batch, n)."""
        g, n, network = self.g, self.n, self._residuals.mass
        if network is None or self._mass is None:
            return None
        tangents = [g.Neg(g.Mul(self._sine, qd)), g.Mul(self._cosine, qd)]
        if self._residuals.encoding.prismatic:
            tangents.append(g.Mul(qd, 1 / self._residuals.encoding.reach))
        tangent = g.Concat(*tangents, axis=1)
        for weight, slope in zip(network.weights[:-1], self._mass.slopes, strict=True):
            tangent = g.Mul(g.MatMul(tangent, weight.T), slope)
        rate = g.MatMul(tangent, network.weights[-1].T)
        across = g.reshaped(qd, 0, n, 1)
        squares = g.reshaped(g.Mul(across, g.reshaped(qd, 0, 1, n)), 0, n * n)
        kinetic = self._vjp(network, self._mass, g.MatMul(squares, 0.5 * network.weights[-1]))
        moved = g.reshaped(g.MatMul(g.reshaped(rate, 0, n, n), across), 0, n)
        found: str = g.Sub(moved, kinetic)
        return found

    @cached_property
    def gravity(self) -> list[str]:
        """Parts of dV/dq, (batch, n) each."""
        g, found, residuals = self.g, [], self._residuals
        if residuals.potential is not None:
            passed, (row,) = self._passed(residuals.potential), residuals.potential.weights[-1]
            found.append(self._vjp(residuals.potential, passed, g.constant(row)))
        if residuals.torque.joints:
            found.append(self._spline_values(residuals.torque))
        if residuals.ripple:
            found.append(self._ripple(residuals.ripple))
        return found

    @cached_property
    def friction_factor(self) -> str | None:
        """What friction is multiplied by, (batch, n)."""
        splines = self._residuals.friction
        return self.g.Exp(self._spline_values(splines)) if splines.joints else None

    def _vjp(self, network: Network, passed: _Pass, by_hidden: str) -> str:
        """d/dq, (batch, n), of what has this derivative by the last hidden layer."""
        g, encoding = self.g, self._residuals.encoding
        for k in reversed(range(len(passed.slopes))):
            by_hidden = g.MatMul(g.Mul(by_hidden, passed.slopes[k]), network.weights[k])
        parts = g.split(by_hidden, [self.n] * (3 if encoding.prismatic else 2), 1)
        found: str = g.Sub(g.Mul(parts[1], self._cosine), g.Mul(parts[0], self._sine))
        if encoding.prismatic:
            found = g.Add(found, g.Mul(parts[2], 1 / encoding.reach))
        return found

    def _spline_values(self, splines: Splines) -> str:
        """The sums of splines, (batch, n); zero for joints without."""
        g, (count, size) = self.g, splines.weights.shape
        joints = np.repeat(np.eye(self.n)[list(splines.joints)], size, axis=0)
        spacing = np.repeat(splines.spacing, size)
        middle = np.repeat(splines.center, size) + spacing * np.tile(np.arange(size) - (size - 1) / 2, count)
        away = g.Abs(g.Mul(g.Sub(g.MatMul(self._q, joints.T), middle), 1 / spacing))
        wide, narrow = (g.Relu(g.Sub(float(reach), away)) for reach in (2, 1))
        cubes = [g.Mul(g.Mul(x, x), x) for x in (wide, narrow)]
        height = g.Sub(g.Mul(cubes[0], 1 / 6), g.Mul(cubes[1], 4 / 6))
        found: str = g.MatMul(height, joints * splines.weights.reshape(-1, 1))
        return found

    def _ripple(self, ripple: tuple[Harmonics, ...]) -> str:
        """(batch, n)."""
        g, own = self.g, np.eye(self.n)
        joints = np.concatenate([np.tile(own[each.joint], (len(each.cosines), 1)) for each in ripple])
        frequencies = np.concatenate(
            [each.frequency * np.arange(1, len(each.cosines) + 1) for each in ripple]
        )
        terms = np.concatenate([[each.cosines, each.sines] for each in ripple], axis=1)
        phase = g.MatMul(self._q, joints.T * frequencies)
        both = g.Concat(g.Cos(phase), g.Sin(phase), axis=1)
        found: str = g.MatMul(both, (joints * terms[:, :, None]).reshape(-1, self.n))
        return found
