"""Networks and Fourier series of q as an ONNX graph, with their derivatives written out as in the runtime."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from spelgen.exporting.description import Encoding, Functions, Learned, TrainedModel
from spelgen.exporting.onnx_graph import OnnxGraph


@dataclass(frozen=True)
class _Pass:
    """A network's work at q: its rows (batch, rows), and by layer the slopes of its units."""

    rows: str
    slopes: tuple[str, ...]


class OnnxLearned:
    """Learned M and V at q, (batch, n)."""

    def __init__(self, model: TrainedModel, graph: OnnxGraph, q: str) -> None:
        assert model.learned is not None
        self.g, self.n, self._q = graph, model.n, q
        self._learned: Learned = model.learned
        self._encoding: Encoding = model.learned.encoding

    @cached_property
    def encoded(self) -> str:
        """What networks read, (batch, 2 n) or (batch, 3 n)."""
        g, parts = self.g, [self._cosine, self._sine]
        if self._encoding.prismatic:
            parts.append(self._scaled)
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

    @cached_property
    def _scaled(self) -> str:
        found: str = self.g.Mul(self.g.Sub(self._q, self._encoding.center), 1 / self._encoding.reach)
        return found

    @cached_property
    def _features(self) -> tuple[str, str]:
        """The Fourier features, cosines and sines, (batch, K) each."""
        g, powers = self.g, self._encoding.powers
        angle = g.MatMul(self._q, self._encoding.frequencies.T)
        cosine, sine = g.Cos(angle), g.Sin(angle)
        if powers.any():
            raised = g.Pow(g.reshaped(self._scaled, 0, 1, self.n), powers)
            size = g.ReduceProd(raised, np.array([2]), keepdims=0)
            cosine, sine = g.Mul(size, cosine), g.Mul(size, sine)
        return cosine, sine

    def _passed(self, functions: Functions) -> _Pass:
        g, layer, slopes = self.g, self.encoded, []
        for weight, bias in zip(functions.weights[:-1], functions.biases, strict=False):
            layer = g.Sigmoid(g.Gemm(layer, weight, bias, transB=1))
            slopes.append(g.Sub(layer, g.Mul(layer, layer)))
        rows = g.Gemm(layer, functions.weights[-1], functions.biases[-1], transB=1)
        return _Pass(rows, tuple(slopes))

    @cached_property
    def _mass(self) -> _Pass:
        return self._passed(self._learned.mass)

    @cached_property
    def _constant(self) -> bool:
        return not self._learned.mass.weights

    @cached_property
    def mass(self) -> str:
        """Without the bound, (batch, n, n)."""
        g, functions = self.g, self._learned.mass
        if self._constant:
            still = g.Mul(g.reshaped(self._q, 0, self.n, 1), np.zeros((1, self.n)))
            found: str = g.Add(still, functions.biases[-1].reshape(self.n, self.n))
            return found
        rows = self._mass.rows
        if functions.series is not None:
            rows = g.Add(rows, g.MatMul(g.Concat(*self._features, axis=1), functions.series.T))
        return g.reshaped(rows, 0, self.n, self.n)

    def coriolis(self, qd: str) -> str:
        """dM/dt qd - d/dq (1/2 qd^T M qd), (batch, n); qd: (batch, n)."""
        g, n, functions = self.g, self.n, self._learned.mass
        if self._constant:
            found: str = g.Mul(qd, np.zeros(n))
            return found
        tangents = [g.Neg(g.Mul(self._sine, qd)), g.Mul(self._cosine, qd)]
        if self._encoding.prismatic:
            tangents.append(g.Mul(qd, 1 / self._encoding.reach))
        tangent = g.Concat(*tangents, axis=1)
        for weight, slope in zip(functions.weights[:-1], self._mass.slopes, strict=True):
            tangent = g.Mul(g.MatMul(tangent, weight.T), slope)
        rate = g.MatMul(tangent, functions.weights[-1].T)
        across = g.reshaped(qd, 0, n, 1)
        squares = g.reshaped(g.Mul(across, g.reshaped(qd, 0, 1, n)), 0, n * n)
        kinetic = self._by_joint(
            self._vjp(functions, self._mass, g.MatMul(squares, 0.5 * functions.weights[-1]))
        )
        if functions.series is not None:
            rate = g.Add(rate, g.MatMul(self._features_jvp(qd), functions.series.T))
            by_features = g.MatMul(squares, 0.5 * functions.series)
            kinetic = g.Add(kinetic, self._features_vjp(by_features))
        moved = g.reshaped(g.MatMul(g.reshaped(rate, 0, n, n), across), 0, n)
        found = g.Sub(moved, kinetic)
        return found

    def gravity(self) -> str:
        """dV/dq, (batch, n)."""
        g, functions = self.g, self._learned.potential
        if functions is None:
            found: str = g.Mul(self._q, np.zeros(self.n))
            return found
        passed = self._passed(functions)
        by_hidden = g.Mul(passed.slopes[-1], functions.weights[-1])
        by_encoded = self._vjp(functions, passed, by_hidden, sloped=True)
        found = self._by_joint(by_encoded)
        if functions.series is not None:
            constant = g.Add(g.Mul(g.Concat(*self._features, axis=1), 0.0), functions.series)
            found = g.Add(found, self._features_vjp(constant))
        return found

    def _vjp(self, functions: Functions, passed: _Pass, by_hidden: str, *, sloped: bool = False) -> str:
        """The derivative by the encoding of what has this one by the last hidden layer."""
        g = self.g
        for k in reversed(range(len(passed.slopes))):
            by_sum = by_hidden if sloped else g.Mul(by_hidden, passed.slopes[k])
            by_hidden, sloped = g.MatMul(by_sum, functions.weights[k]), False
        return by_hidden

    def _by_joint(self, by_encoded: str) -> str:
        """d/dq, (batch, n), of what has this derivative by the encoding."""
        g = self.g
        parts = g.split(by_encoded, [self.n] * (3 if self._encoding.prismatic else 2), 1)
        found: str = g.Sub(g.Mul(parts[1], self._cosine), g.Mul(parts[0], self._sine))
        if self._encoding.prismatic:
            found = g.Add(found, g.Mul(parts[2], 1 / self._encoding.reach))
        return found

    def _features_jvp(self, qd: str) -> str:
        """How fast the features change along qd, (batch, 2 K)."""
        g, (cosine, sine) = self.g, self._features
        turned = g.MatMul(qd, self._encoding.frequencies.T)
        rates = [g.Neg(g.Mul(sine, turned)), g.Mul(cosine, turned)]
        if self._encoding.powers.any():
            across = g.reshaped(qd, 0, 1, self.n)
            slid = [g.MatMul(across, self._by_sliding(x)) for x in (cosine, sine)]
            count = len(self._encoding.powers)
            rates = [g.Add(a, g.reshaped(b, 0, count)) for a, b in zip(rates, slid, strict=True)]
        found: str = g.Concat(*rates, axis=1)
        return found

    def _features_vjp(self, by_features: str) -> str:
        """d/dq, (batch, n), of what has this derivative, (batch, 2 K), by the features."""
        g, (cosine, sine) = self.g, self._features
        count = len(self._encoding.powers)
        by_cos, by_sin = g.split(by_features, [count, count], 1)
        turned = g.Sub(g.Mul(by_sin, cosine), g.Mul(by_cos, sine))
        found: str = g.MatMul(turned, self._encoding.frequencies)
        if self._encoding.powers.any():
            for feature, by_feature in ((cosine, by_cos), (sine, by_sin)):
                slid = g.MatMul(self._by_sliding(feature), g.reshaped(by_feature, 0, count, 1))
                found = g.Add(found, g.reshaped(slid, 0, self.n))
        return found

    def _by_sliding(self, feature: str) -> str:
        """d/dq of K features by prismatic joints, (batch, n, K)."""
        powers, frequencies = self._encoding.powers, self._encoding.frequencies
        keys = [(tuple(f), tuple(p)) for f, p in zip(frequencies, powers, strict=True)]
        count, lower = len(keys), np.zeros((len(keys), self.n, len(keys)))
        for place, (frequency, power) in enumerate(keys):
            for joint in np.flatnonzero(power):
                less = tuple(value - (k == joint) for k, value in enumerate(power))
                lower[keys.index((frequency, less)), joint, place] = (
                    power[joint] / self._encoding.reach[joint]
                )
        found: str = self.g.MatMul(feature, lower.reshape(count, -1))
        return self.g.reshaped(found, 0, self.n, count)
