"""What stands beside rigid bodies, as CasADi symbols for what is given of it at q.

So a program may loop over weights and look up splines: values, and either their rates along qd or their first and
second derivatives by q.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np

from spelgen.exporting.description import TrainedModel

Level = Literal["values", "rates", "jets"]
"""What is given of residuals: values; also what forces need along qd; or first and second derivatives by q."""


@dataclass(frozen=True, eq=False)
class ResidualSymbols:
    """What is given of the residuals of M's entries (m, 1), of V, and of single joints.

    values and rates: ``rate``, how fast the entries change along qd (m, 1), ``kinetic``, d/dq of their
    1/2 qd^T M qd (n, 1), ``gravity``, dV/dq of the network (n, 1), ``energy``, its V. jets: derivatives by q, second
    ones by row and column of the upper triangle: ``first`` (m, n) and ``second`` (m, n (n + 1) / 2) of the entries,
    ``gravity`` and ``stiffness`` (n (n + 1) / 2, 1) of V. Of single joints: ``torque`` (n, 1), its slope by q, its
    energy; of those whose friction varies (k, 1) the ``factor``'s logarithm and its slope.
    """

    mass: ca.SX
    rate: ca.SX
    kinetic: ca.SX
    first: ca.SX
    second: ca.SX
    energy: ca.SX
    gravity: ca.SX
    stiffness: ca.SX
    torque: ca.SX
    torque_slope: ca.SX
    torque_energy: ca.SX
    factor: ca.SX
    factor_slope: ca.SX

    @classmethod
    def of(cls, model: TrainedModel) -> ResidualSymbols:
        """Symbols for what a model has; empty ones for what it has not."""
        residuals, n = model.residuals, model.n
        entries, pairs = len(entry_places(model)), n * (n + 1) // 2
        v, t, k = (
            int(residuals.potential is not None),
            int(residuals.has_torque),
            len(residuals.friction.joints),
        )
        return cls(
            mass=ca.SX.sym("mass", entries),
            rate=ca.SX.sym("rate", entries),
            kinetic=ca.SX.sym("kinetic", n if entries else 0),
            first=ca.SX.sym("first", entries, n),
            second=ca.SX.sym("second", entries, pairs),
            energy=ca.SX.sym("energy", v),
            gravity=ca.SX.sym("gravity", v * n),
            stiffness=ca.SX.sym("stiffness", v * pairs),
            torque=ca.SX.sym("torque", t * n),
            torque_slope=ca.SX.sym("torque_slope", t * n),
            torque_energy=ca.SX.sym("torque_energy", t),
            factor=ca.SX.sym("factor", k),
            factor_slope=ca.SX.sym("factor_slope", k),
        )


def entry_places(model: TrainedModel) -> list[tuple[int, int]]:
    """The places in M's lower triangle that a network reaches."""
    network, n = model.residuals.mass, model.n
    if network is None:
        return []
    reached = (network.weights[-1] != 0).any(axis=1).reshape(n, n)
    return [(row, column) for row in range(n) for column in range(row + 1) if reached[row, column]]


def placed(n: int, places: list[tuple[int, int]], values: ca.SX) -> ca.SX:
    """The symmetric matrix, (n, n), with these entries at their places."""
    matrix = ca.SX(n, n)
    for k, (row, column) in enumerate(places):
        matrix[row, column] = values[k]
        matrix[column, row] = values[k]
    return matrix


def coriolis(given: ResidualSymbols, places: list[tuple[int, int]], level: Level, qd: ca.SX) -> ca.SX:
    """dR/dt qd - d/dq (1/2 qd^T R qd), (n, 1), of what networks add to M."""
    n = qd.numel()
    if level != "jets":
        return placed(n, places, given.rate) @ qd - given.kinetic
    rate = placed(n, places, given.first @ qd)
    each = [placed(n, places, given.first[:, i]) for i in range(n)]
    return rate @ qd - ca.vertcat(*(0.5 * ca.dot(qd, by_joint @ qd) for by_joint in each))


def jets(model: TrainedModel, given: ResidualSymbols) -> list[tuple[ca.SX, ca.SX]]:
    """Symbols that depend on q, (k, 1) each, with their derivatives by it, (k, n)."""
    n = model.n
    found = [
        (given.mass, given.first),
        (ca.vec(given.first), ca.vertcat(*(given.second[:, _pairs(n, joint)] for joint in range(n)))),
        (given.factor, given.factor_slope * ca.SX(np.eye(n)[list(model.residuals.friction.joints)])),
    ]
    if model.residuals.potential is not None:
        found.append((given.gravity, ca.vertcat(*(given.stiffness[_pairs(n, j)].T for j in range(n)))))
    if model.residuals.has_torque:
        found.append((given.torque, ca.diag(given.torque_slope)))
    return [(symbols, slopes) for symbols, slopes in found if symbols.numel()]


def _pairs(n: int, joint: int) -> list[int]:
    """Where the second derivatives by a joint and each other stand, row by row of an upper triangle."""
    upper = [(i, j) for i in range(n) for j in range(i, n)]
    return [upper.index((min(i, joint), max(i, joint))) for i in range(n)]
