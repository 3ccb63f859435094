"""The functions of single joints as an ONNX graph: all splines and harmonics in one product."""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np

from spelgen.exporting.description import Splines, TrainedModel
from spelgen.exporting.onnx_graph import OnnxGraph


class OnnxJointFunctions:
    """Torques and factors on friction at q, (batch, n); None where the model has none."""

    def __init__(self, model: TrainedModel, graph: OnnxGraph, q: str) -> None:
        self.g, self.n, self._q, self._residuals = graph, model.n, q, model.residuals

    @cached_property
    def torque(self) -> str | None:
        """dV/dq."""
        return self._columns[0] if self._residuals.has_torque else None

    @cached_property
    def friction_factor(self) -> str | None:
        """What friction is multiplied by."""
        return self.g.Exp(self._columns[-1]) if self._residuals.friction.joints else None

    @cached_property
    def _columns(self) -> list[str]:
        """The torque, the logarithm of the factor; without what the model does not have."""
        torque, friction = self._residuals.torque, self._residuals.friction
        kinds = [*([torque] if self._residuals.has_torque else []), *([friction] if friction.joints else [])]
        features, weights = [], []
        if torque.joints or friction.joints:
            found, rows = self._splines(kinds)
            features.append(found)
            weights.append(rows)
        if self._residuals.ripple:
            found, rows = self._ripple()
            features.append(found)
            weights.append(np.pad(rows, ((0, 0), (0, self.n * (len(kinds) - 1)))))
        whole = features[0] if len(features) == 1 else self.g.Concat(*features, axis=1)
        return self.g.split(self.g.MatMul(whole, np.concatenate(weights)), [self.n] * len(kinds), 1)

    def _splines(self, kinds: list[Splines]) -> tuple[str, np.ndarray]:
        """A B-spline is (2 - away)^3 / 6 - 4 (1 - away)^3 / 6 of what is positive: these cubes, and their weights."""
        g, own, size = self.g, np.eye(self.n), kinds[0].weights.shape[1]
        places = {}  # by joint where its splines begin, and their spacing: the same in all kinds
        for each in kinds:
            for joint, center, spacing in zip(each.joints, each.center, each.spacing, strict=True):
                places[joint] = (center - spacing * (size - 1) / 2, spacing)
        first, spacing = np.array(list(places.values())).T
        middles = (first / spacing)[:, None] + np.arange(size)
        scales = np.repeat(own[list(places)] / spacing[:, None], size, axis=0)
        away = g.Abs(g.Gemm(self._q, np.tile(scales, (2, 1)), -np.tile(middles.ravel(), 2), transB=1))
        reach = np.repeat([2.0, 1.0], len(scales))
        weights = np.zeros((len(places), size, len(kinds), self.n))
        for k, each in enumerate(kinds):
            for joint, row in zip(each.joints, each.weights, strict=True):
                weights[list(places).index(joint), :, k, joint] = row / 6
        rows = weights.reshape(len(scales), -1)
        return g.Pow(g.Relu(g.Sub(reach, away)), 3.0), np.concatenate([rows, -4 * rows])

    def _ripple(self) -> tuple[str, np.ndarray]:
        """Products that add up to the harmonics, and their weights.

        Sines are dear: harmonic k = size a + b is made of those of size a and of b, about 2 sqrt(K) in place of K.
        """
        g, ripple, own = self.g, self._residuals.ripple, np.eye(self.n)
        coarse, fine, between, owners = [], [], [], []
        for each in ripple:
            size = math.ceil(math.sqrt(len(each.cosines)))
            many = -(-len(each.cosines) // size)
            joint = each.frequency * own[each.joint]
            coarse.append(_phases(size * np.arange(many), joint))
            fine.append(_phases(np.arange(1, size + 1), joint))
            cosines, sines = (
                np.pad(terms, (0, many * size - len(terms))).reshape(many, size).T
                for terms in (each.cosines, each.sines)
            )
            between.append(np.block([[cosines, sines], [sines, -cosines]]))
            owners.append(np.tile(own[each.joint], (2 * many, 1)))
        phases = np.concatenate([*fine, *coarse])
        quarter = np.concatenate([np.repeat([np.pi / 2, 0.0], len(each) // 2) for each in (*fine, *coarse)])
        sizes = [sum(map(len, fine)), sum(map(len, coarse))]
        small, large = g.split(g.Sin(g.Gemm(self._q, phases, quarter, transB=1)), sizes, 1)
        return g.Mul(g.MatMul(small, _block_diagonal(between)), large), np.concatenate(owners)


def _phases(multiples: np.ndarray, joint: np.ndarray) -> np.ndarray:
    """Those of cosines, then of sines, by q, (2 multiples, n)."""
    found: np.ndarray = np.tile(multiples[:, None] * joint, (2, 1))
    return found


def _block_diagonal(blocks: list[np.ndarray]) -> np.ndarray:
    """The matrix with these blocks, of any shapes, on its diagonal."""
    found = np.zeros(np.sum([block.shape for block in blocks], axis=0))
    row = column = 0
    for block in blocks:
        found[row : row + block.shape[0], column : column + block.shape[1]] = block
        row, column = row + block.shape[0], column + block.shape[1]
    return found
