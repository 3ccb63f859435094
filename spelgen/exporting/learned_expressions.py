"""Learned functions of q as CasADi expressions: what is known in closed form, and symbols for what networks give.

A network enters as symbols, so that a program may loop over its weights: its values, and either their rates along qd or
their first and second derivatives by q.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca
import numpy as np

from spelgen.exporting.description import Bound, Encoding, Functions, Learned, TrainedModel

Level = Literal["values", "rates", "jets"]
"""What of the networks is given: values; also what forces need along qd; or first and second derivatives by q."""


@dataclass(frozen=True, eq=False)
class NetworkSymbols:
    """What is given of the networks of M's entries (m, 1) and of V.

    values and rates: ``rate``, how fast the entries change along qd (m, 1), ``kinetic``, d/dq of their
    1/2 qd^T M qd (n, 1), ``gravity``, dV/dq (n, 1), ``energy``. jets: derivatives by q, second ones by row and column
    of the upper triangle: ``first`` (m, n) and ``second`` (m, n (n + 1) / 2) of the entries, ``gravity`` and
    ``stiffness`` (n (n + 1) / 2, 1) of V.
    """

    mass: ca.SX
    energy: ca.SX
    gravity: ca.SX
    rate: ca.SX
    kinetic: ca.SX
    first: ca.SX
    second: ca.SX
    stiffness: ca.SX

    @classmethod
    def of(cls, n: int, entries: int, potential: bool) -> NetworkSymbols:
        """Symbols for so many entries of M, and for V where a network gives part of it."""
        v, pairs = int(potential), n * (n + 1) // 2
        return cls(
            mass=ca.SX.sym("mass", entries),
            energy=ca.SX.sym("energy", v),
            gravity=ca.SX.sym("gravity", v * n),
            rate=ca.SX.sym("rate", entries),
            kinetic=ca.SX.sym("kinetic", n if entries else 0),
            first=ca.SX.sym("first", entries, n),
            second=ca.SX.sym("second", entries, pairs),
            stiffness=ca.SX.sym("stiffness", v * pairs),
        )


def entry_places(model: TrainedModel) -> list[tuple[int, int]]:
    """The places in M's lower triangle that a network reaches."""
    if model.learned is None:
        return []
    reached = model.learned.mass.reached.reshape(model.n, model.n)
    return [(row, column) for row in range(model.n) for column in range(row + 1) if reached[row, column]]


def has_potential_network(model: TrainedModel) -> bool:
    """Whether a network gives part of V."""
    potential = None if model.learned is None else model.learned.potential
    return potential is not None and bool(potential.reached.any())


def placed(n: int, places: list[tuple[int, int]], values: ca.SX) -> ca.SX:
    """The symmetric matrix, (n, n), with these entries at their places."""
    matrix = ca.SX(n, n)
    for k, (row, column) in enumerate(places):
        matrix[row, column] = values[k]
        matrix[column, row] = values[k]
    return matrix


def encoded(encoding: Encoding, q: Any) -> Any:
    """What networks read of q: SX or MX, as q is."""
    parts = [ca.cos(q), ca.sin(q)]
    if encoding.prismatic:
        parts.append((q - encoding.center) / encoding.reach)
    return ca.vertcat(*parts)


def known_part(learned: Learned, functions: Functions, q: ca.SX) -> ca.SX:
    """What needs no network: constants of the rows that none reaches, and the Fourier series."""
    rows = ca.SX(ca.sparsify(ca.DM(np.where(functions.reached, 0.0, functions.biases[-1]))))
    if functions.series is not None:
        rows = rows + ca.sparsify(ca.DM(functions.series)) @ features(learned.encoding, q)
    return rows


def features(encoding: Encoding, q: ca.SX) -> ca.SX:
    """``runtime.fourier``'s features, (2 K, 1): by products of the joints' own cosines and sines."""
    scaled = (q - encoding.center) / encoding.reach
    cosines, sines = [], []
    for frequencies, powers in zip(encoding.frequencies, encoding.powers, strict=True):
        c, s = ca.SX(1), ca.SX(0)
        for joint, frequency in enumerate(frequencies):
            own_c, own_s = _multiple(q[joint], int(frequency))
            c, s = c * own_c - s * own_s, s * own_c + c * own_s
        size = ca.SX(1)
        for joint, power in enumerate(powers):
            for _ in range(int(power)):
                size = size * scaled[joint]
        cosines.append(size * c)
        sines.append(size * s)
    return ca.vertcat(*cosines, *sines)


def _multiple(angle: ca.SX, times: int) -> tuple[ca.SX, ca.SX]:
    """cos and sin of a whole multiple of an angle."""
    c, s = ca.SX(1), ca.SX(0)
    for _ in range(abs(times)):
        c, s = c * ca.cos(angle) - s * ca.sin(angle), s * ca.cos(angle) + c * ca.sin(angle)
    return c, s if times >= 0 else -s


def bound_part(bound: Bound, mass: ca.SX) -> ca.SX:
    """t of ``runtime.regularisation``: how much of M - center is taken."""
    pivots = factor(mass - bound.least)[1]
    definite = pivots[0] > 0
    for pivot in pivots[1:]:
        definite = ca.logic_and(definite, pivot > 0)
    size = ca.norm_fro(bound.unit * (mass - bound.center))
    drawn = 2 ** -ca.fmax(ca.ceil(ca.log(size) / np.log(2)), 1)
    return ca.if_else(definite, 1, drawn)


def factor(matrix: ca.SX) -> tuple[list[list[ca.SX]], list[ca.SX], list[ca.SX]]:
    """L, unit lower triangular, D, and D^-1 of a symmetric matrix L D L^T."""
    n = matrix.shape[0]
    lower = [[ca.SX(0)] * n for _ in range(n)]
    pivots: list[ca.SX] = []
    inverses: list[ca.SX] = []
    for j in range(n):
        scaled = [lower[j][k] * pivots[k] for k in range(j)]
        pivots.append(matrix[j, j] - sum((lower[j][k] * scaled[k] for k in range(j)), ca.SX(0)))
        inverses.append(1 / pivots[j])
        for i in range(j + 1, n):
            rest = sum((lower[i][k] * scaled[k] for k in range(j)), ca.SX(0))
            lower[i][j] = (matrix[i, j] - rest) * inverses[j]
    return lower, pivots, inverses


def solved(matrix: ca.SX, right: ca.SX) -> ca.SX:
    """matrix^-1 right of a symmetric positive definite matrix; right: (n, columns)."""
    n = matrix.shape[0]
    lower, _, inverses = factor(matrix)
    rows = [right[i, :] for i in range(n)]
    for i in range(n):
        for k in range(i):
            rows[i] = rows[i] - lower[i][k] * rows[k]
    rows = [row * scale for row, scale in zip(rows, inverses, strict=True)]
    for i in reversed(range(n)):
        for k in range(i + 1, n):
            rows[i] = rows[i] - lower[k][i] * rows[k]
    return ca.vertcat(*rows)
