"""The networks beside rigid bodies as an ONNX graph, with their derivatives by the joints.

The networks of M and V go through their layers side by side, and values and derivatives one below the other: for one
state a node costs more than its numbers.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from spelgen.exporting.description import Encoding, Network, TrainedModel
from spelgen.exporting.onnx_graph import OnnxGraph

SURELY_ONE = 40.0  # the hyperbolic tangent is one to the last digit


class OnnxResiduals:
    """What networks add at q, (batch, n).

    Units are hyperbolic tangents here: tanh(a / 2) = 2 sigmoid(a) - 1 takes ONNX Runtime half the time. Behind the
    units of M and of V each layer has one that is always one, by which biases come in. V is a unit as well, of which
    the derivative is read before its hyperbolic tangent is taken.
    """

    def __init__(self, model: TrainedModel, graph: OnnxGraph, q: str, *, moving: bool) -> None:
        """moving: derivatives are asked for as well."""
        self.g, self.n, self._q, self._encoding = graph, model.n, q, model.residuals.encoding
        self._moving, self._constant_mass = moving, model.constant_mass
        self._mass, self._potential = (
            _readings(each) for each in (model.residuals.mass, model.residuals.potential)
        )
        read = (3 if self._encoding.prismatic else 2) * model.n
        self._weights, self._places = _side_by_side([self._mass[:-1], self._potential], read)

    @cached_property
    def _layers(self) -> list[tuple[str, str, str]]:
        """By layer the values of the units and the one, their slopes, (batch, 1, units), and before these are taken,
        in the last rows, derivatives by the joints, (batch, rows, units).
        """
        g = self.g
        found: list[tuple[str, str, str]] = []
        table, constant = _encoding_rows(self._encoding, self.n)
        if not self._moving:
            table, constant = table[:1], constant[:1]
        waves = g.waves(self._q, np.eye(self.n))
        features = g.Concat(waves, self._q, axis=1) if self._encoding.prismatic else waves
        flat = g.Gemm(features, table.reshape(-1, table.shape[2]), constant.ravel(), transB=1)
        rows = g.reshaped(flat, 0, *constant.shape)
        for k, weights in enumerate(self._weights):
            before = g.MatMul(rows, weights)
            values = g.Tanh(g.Gather(before, np.array([0]), axis=1))
            slopes = g.Sub(1.0, g.Mul(values, values))
            found.append((values, slopes, before))
            if k + 1 < len(self._weights):
                # values come on top: a row that nobody reads costs less than a node
                rows = g.Concat(values, g.Mul(before, slopes), axis=1)
        return found

    def _derivatives(self, layer: int) -> str:
        """By the joints of what units read, (batch, n, units)."""
        found: str = self.g.Gather(self._layers[layer][2], np.arange(-self.n, 0), axis=1)
        return found

    @cached_property
    def _last(self) -> np.ndarray:
        """How M is read of its last hidden layer, (units and the one, n n)."""
        layer = len(self._mass) - 2
        found = np.zeros((self._weights[layer].shape[1], self.n**2))
        found[np.append(self._places[layer][0], -1)] = self._mass[-1]
        return found

    @cached_property
    def mass(self) -> list[str]:
        """What is added to the bodies' M, constants among it, (n, n) or (batch, n, n); nothing where it is zero."""
        g, constant = self.g, self._constant_mass
        if not self._mass:
            return [g.constant(constant)] if constant.any() else []
        last = self._last.copy()
        last[-1] += constant.ravel()
        return [g.reshaped(g.MatMul(self._layers[len(self._mass) - 2][0], last), 0, self.n, self.n)]

    @cached_property
    def gravity(self) -> list[str]:
        """dV/dq, (batch, n), where there is one."""
        if not self._potential:
            return []
        layer = len(self._potential) - 1
        ((unit,),) = self._places[layer][1:]
        return [self.g.Gather(self._derivatives(layer), np.array(unit), axis=2)]

    def coriolis(self, qd: str) -> list[str]:
        """dR/dt qd and - d/dq (1/2 qd^T R qd), (batch, 1, n), of what is added to M; qd: (batch, n)."""
        if not self._mass:
            return []
        g, n, layer = self.g, self.n, len(self._mass) - 2
        last = self._last.copy()
        last[-1] = 0.0  # a constant moves nothing
        by_unit = last.reshape(-1, n, n).transpose(1, 0, 2).reshape(n, -1)
        moved = g.reshaped(g.MatMul(qd, by_unit), 0, len(last), n)  # what each unit adds to R qd
        # R qd by the position of a joint
        by_joint = g.MatMul(g.Mul(self._derivatives(layer), self._layers[layer][1]), moved)
        row = g.reshaped(qd, 0, 1, n)
        kinetic = g.MatMul(g.Mul(row, -0.5), g.Transpose(by_joint, perm=[0, 2, 1]))
        return [g.MatMul(row, by_joint), kinetic]


def _readings(network: Network | None) -> list[np.ndarray]:
    """By layer, (units below and the one, units), with tanh(a / 2) in place of sigmoid(a); none without a network."""
    if network is None:
        return []
    last, found = len(network.weights) - 1, []
    for k, (weights, biases) in enumerate(zip(network.weights, network.biases, strict=True)):
        if k > 0:
            weights, biases = weights / 2, biases + weights.sum(axis=1) / 2
        found.append(np.vstack([weights.T, biases]) / (1 if k == last else 2))
    return found


def _side_by_side(
    networks: list[list[np.ndarray]], read: int
) -> tuple[list[np.ndarray], list[list[np.ndarray]]]:
    """By layer, of networks that read the same: (units below and the one, units and the one); by network its units."""
    below, places = [np.arange(read)] * len(networks), []
    weights: list[np.ndarray] = []
    for k in range(max(map(len, networks))):
        sizes = [each[k].shape[1] if k < len(each) else 0 for each in networks]
        units = np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1])
        whole = np.zeros((weights[-1].shape[1] if weights else read + 1, sum(sizes) + 1))
        whole[-1, -1] = SURELY_ONE
        for each, rows, columns in zip(networks, below, units, strict=True):
            if k < len(each):
                whole[np.ix_(np.append(rows, -1), columns)] = each[k]
        weights.append(whole)
        places.append(units)
        below = units
    return weights, places


def _encoding_rows(encoding: Encoding, n: int) -> tuple[np.ndarray, np.ndarray]:
    """What networks read and the one, then derivatives by the joints, (1 + n, read + 1): by waves, and by q where some
    joint slides, (1 + n, read + 1, features), and what is added.
    """
    read, joint = (3 if encoding.prismatic else 2) * n, np.arange(n)
    table, constant = np.zeros((1 + n, read + 1, read)), np.zeros((1 + n, read + 1))
    constant[0, -1] = 1.0
    table[0, : 2 * n, : 2 * n] = np.eye(2 * n)
    table[1 + joint, joint, n + joint] = -1.0
    table[1 + joint, n + joint, joint] = 1.0
    if encoding.prismatic:
        sliding = 2 * n + joint
        table[0, sliding, sliding] = constant[1 + joint, sliding] = 1 / encoding.reach
        constant[0, sliding] = -encoding.center / encoding.reach
    return table, constant
