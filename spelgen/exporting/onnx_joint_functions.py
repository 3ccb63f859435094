"""The functions of single joints as an ONNX graph: the terms of all joints at once, then their sums."""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np

from spelgen.exporting.description import Harmonics, Splines, TrainedModel
from spelgen.exporting.onnx_graph import OnnxGraph


class OnnxJointFunctions:
    """Torques and factors on friction at q, (batch, n)."""

    def __init__(self, model: TrainedModel, graph: OnnxGraph, q: str) -> None:
        self.g, self.n, self._q, self._residuals = graph, model.n, q, model.residuals
        splines, turning = (model.residuals.torque, model.residuals.friction), model.residuals.ripple
        joints = {each.joint for each in turning}.union(*(each.joints for each in splines))
        self._joints = sorted(joints)  # which have functions of their own

    @cached_property
    def torque(self) -> list[str]:
        """Parts of dV/dq."""
        splines, ripple = self._residuals.torque, self._residuals.ripple
        return [*([self._spline(splines)] if splines.joints else []), *([self._ripple] if ripple else [])]

    @cached_property
    def friction_factor(self) -> str | None:
        """What friction is multiplied by; None where there is none."""
        splines = self._residuals.friction
        return self.g.Exp(self._spline(splines)) if splines.joints else None

    def _read(self, scales: np.ndarray, offsets: np.ndarray) -> str:
        """scales q + offsets, (batch, joints, 1, terms); both are (joints, terms)."""
        rows = scales[:, :, None] * np.eye(self.n)[self._joints, None]
        read = self.g.Gemm(self._q, rows.reshape(-1, self.n), offsets.ravel(), transB=1)
        return self.g.reshaped(read, 0, len(rows), 1, rows.shape[1])

    def _summed(self, terms: str) -> str:
        """(batch, joints, 1, terms) to (batch, n)."""
        found: str = self.g.ReduceSum(terms, np.array([2, 3]), keepdims=0)
        return found if len(self._joints) == self.n else self.g.MatMul(found, np.eye(self.n)[self._joints])

    def _spline(self, splines: Splines) -> str:
        """Sums of B-splines, (batch, n)."""
        size = splines.weights.shape[1]
        weights = np.zeros((len(self._joints), 1, size))
        weights[[self._joints.index(joint) for joint in splines.joints], 0] = splines.weights / 6
        return self._summed(self.g.Mul(self._cubes, np.concatenate([weights, -4 * weights], axis=2)))

    @cached_property
    def _cubes(self) -> str:
        """Of which B-splines are made, (2 - away)^3 / 6 - 4 (1 - away)^3 / 6 of what is positive, twice as many."""
        kinds = [each for each in (self._residuals.torque, self._residuals.friction) if each.joints]
        g, many, size = self.g, len(self._joints), kinds[0].weights.shape[1]
        center, spacing = np.zeros((many, 1)), np.ones((many, 1))
        for each in kinds:  # a joint's splines are the same in both
            at = [self._joints.index(joint) for joint in each.joints]
            center[at, 0], spacing[at, 0] = each.center, each.spacing
        middles = center / spacing + np.arange(size) - (size - 1) / 2
        away = g.Abs(self._read(np.tile(1 / spacing, 2 * size), -np.tile(middles, 2)))
        reach = np.tile(np.repeat([2.0, 1.0], size), (many, 1, 1))
        return g.Pow(g.Relu(g.Sub(reach, away)), 3.0)

    @cached_property
    def _ripple(self) -> str:
        """Sums of harmonics, (batch, n).

        Sines are dear: harmonic k = size a + b, b of either sign, is made of those of size a and of |b|, about
        3 sqrt(K) in place of 2 K. Harmonics of the motor, which are few, stand for themselves.
        """
        joints, ripple = self._joints, self._residuals.ripple
        rows = [[each for each in ripple if each.joint == joint] for joint in joints]
        longest = max(len(row[0].cosines) for row in rows if row)
        fine = math.isqrt(longest // 2)
        coarse = (longest + fine) // (2 * fine + 1)
        alone = max(sum(len(each.cosines) for each in row[1:]) for row in rows)
        small, large = (np.zeros((len(joints), many)) for many in (fine + 1, coarse + 1 + alone))
        between = np.zeros((len(joints), 2, fine + 1, 2, coarse + 1 + alone))
        for at, row in enumerate(rows):
            if row:
                small[at] = row[0].frequency * np.arange(fine + 1)
                large[at, : coarse + 1] = row[0].frequency * (2 * fine + 1) * np.arange(coarse + 1)
                _add_products(between[at], row[0])
            place = coarse + 1
            for each in row[1:]:
                own = slice(place, place := place + len(each.cosines))
                large[at, own] = each.frequency * np.arange(1, len(each.cosines) + 1)
                between[at, 0, 0, :, own] = each.cosines, each.sines
        mixed = self.g.MatMul(self._waves(small), between.reshape(len(joints), 2 * (fine + 1), -1))
        return self._summed(self.g.Mul(mixed, self._waves(large)))

    def _waves(self, frequencies: np.ndarray) -> str:
        """Cosines, then sines, (batch, joints, 1, waves); frequencies: (joints, half as many)."""
        quarter = np.repeat([[np.pi / 2, 0.0]], len(frequencies), axis=0).repeat(frequencies.shape[1], axis=1)
        found: str = self.g.Sin(self._read(np.tile(frequencies, 2), quarter))
        return found


def _add_products(between: np.ndarray, ripple: Harmonics) -> None:
    """By which products of a fine and a coarse wave harmonics are made, (2, fine, 2, coarse): cosines, sines."""
    fine, k = between.shape[1] - 1, np.arange(1, len(ripple.cosines) + 1)
    coarse = (k + fine) // (2 * fine + 1)
    rest = k - (2 * fine + 1) * coarse
    at, sign = abs(rest), np.sign(rest)
    np.add.at(between, (0, at, 0, coarse), ripple.cosines)
    np.add.at(between, (1, at, 1, coarse), -sign * ripple.cosines)
    np.add.at(between, (0, at, 1, coarse), ripple.sines)
    np.add.at(between, (1, at, 0, coarse), sign * ripple.sines)
