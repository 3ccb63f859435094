"""Derive the base inertial parameters of an arm, exactly: the fewest combinations that M and V are linear in.

Every value of M, and of V less its value elsewhere, is a row of coefficients over the ten parameters of each
body. Rows at random rational configurations span all of them; the reduced echelon form of that span is the
base (Gautier and Khalil, *Direct calculation of minimum set of inertial parameters of serial robots*, IEEE
Trans. Robotics and Automation 6(3), 1990, find the same by rules).
"""

from __future__ import annotations

import random
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache

import numpy as np
from flint import fmpq, fmpq_mat

from spelgen.arm.arm import Arm
from spelgen.structure import field
from spelgen.structure.recursion import PARAMETERS, energies, triangle
from spelgen.structure.sampling import Position, motions

# Parameters that stand for a group if they can; Iyy, hz and m of a turning body can always be regrouped.
_PREFERRED = ("Izz", "Ixx", "Ixy", "Ixz", "Iyz", "hx", "hy", "m", "Iyy", "hz")
_GRID = 1000


@dataclass(frozen=True)
class BaseParameter:
    """Hold a combination of inertial parameters that the motion depends on.

    ``name`` is that of its first parameter, with an R where others are regrouped into it; ``weights`` are
    (parameter, coefficient), parameters counted 10 body + i in the order of ``PARAMETERS``. ``value`` is the
    URDF's, None where a body has no inertial.
    """

    name: str
    index: int
    weights: tuple[tuple[int, Fraction], ...]
    value: Fraction | None


def parameter_name(index: int) -> str:
    """Return its name: ``Izz2`` is the tensor component zz of the second body."""
    return f"{PARAMETERS[index % 10]}{index // 10 + 1}"


@lru_cache(maxsize=16)  # of one arm they are asked for by least squares, logs and closed forms
def base_parameters(arm: Arm, count: int) -> tuple[BaseParameter, ...]:
    """Return the ``count`` base parameters of ``arm``, by body from the root."""
    order: list[int] = []
    for body in range(len(arm.bodies)):
        order += [10 * body + PARAMETERS.index(name) for name in _PREFERRED]
    rows = np.concatenate(list(_enough_rows(arm, count)))[:, order]
    residues = _residues(rows)
    # which parameters are independent shows in the prime field; the coefficients are then solved for exactly
    bound = field.pivots(field.row_basis(residues))
    independent_rows = field.pivots(field.row_basis(residues[:, bound].T))
    # parameters of zero columns move nothing: no base parameter contains them
    moving = np.flatnonzero(residues.any(axis=0)).tolist()
    free = [column for column in moving if column not in bound]
    coefficients = _solved(rows[np.ix_(independent_rows, bound)], rows[np.ix_(independent_rows, free)])
    result = []
    for pivot, regrouped in zip(bound, coefficients, strict=True):
        index = order[pivot]
        name = parameter_name(index)
        weights = [(index, Fraction(1))]
        for column, coefficient in zip(free, regrouped, strict=True):
            if coefficient:
                weights.append((order[column], Fraction(int(coefficient.p), int(coefficient.q))))
        if len(weights) > 1:
            name += "R"
        result.append(BaseParameter(name, index, tuple(weights), _value(arm, weights)))
    return tuple(result)


def _value(arm: Arm, weights: list[tuple[int, Fraction]]) -> Fraction | None:
    total = Fraction(0)
    for index, coefficient in weights:
        inertia = arm.bodies[index // 10].inertia
        if inertia is None:
            return None
        total += coefficient * inertia[index % 10]
    return total


def _enough_rows(arm: Arm, count: int) -> list[np.ndarray]:
    """Return coefficient rows at as many random configurations as it takes to have rank ``count``."""
    generator = random.Random(0)
    reference = _rows(arm, generator)[-1]
    blocks: list[np.ndarray] = []
    residues = np.zeros((0, 10 * len(arm.bodies)), dtype=np.uint64)
    while field.rank(residues) < count:
        rows = _rows(arm, generator)
        rows[-1] = rows[-1] - reference  # a constant part of V moves nothing
        blocks.append(rows)
        residues = np.concatenate([residues, _residues(rows)])
    return blocks


def _rows(arm: Arm, generator: random.Random) -> np.ndarray:
    """Return coefficients of M's entries and of V at one random configuration, (n(n+1)/2 + 1, 10 bodies) of fmpq."""
    n, parameters = len(arm.coordinates), 10 * len(arm.bodies)
    positions = []
    for _ in range(n):
        t = fmpq(generator.randrange(1, _GRID), generator.randrange(1, _GRID))
        value = fmpq(generator.randrange(1, _GRID), generator.randrange(1, _GRID))
        # t is the tangent of half the angle, so that cosine and sine are rational
        norm = 1 + t * t
        positions.append(Position((1 - t * t) / norm, 2 * t / norm, value))
    units = np.full((parameters, parameters), fmpq(0))
    np.fill_diagonal(units, fmpq(1))
    inertias = [list(units[10 * body : 10 * body + 10]) for body in range(len(arm.bodies))]
    result = energies(arm, motions(arm, positions, rational), inertias, rational)
    rows = np.full((n * (n + 1) // 2 + 1, parameters), fmpq(0))
    for row, key in enumerate(triangle(n)):
        rows[row] = _row(result.mass[key], parameters)
    rows[-1] = _row(result.potential, parameters)
    return rows


def _row(element: np.ndarray | int, parameters: int) -> np.ndarray:
    """Return an element of the ring as coefficients; where nothing moves it is a plain 0."""
    if isinstance(element, np.ndarray):
        return element
    return np.full(parameters, fmpq(0))


def _solved(matrix: np.ndarray, right: np.ndarray) -> list[list[fmpq]]:
    if not right.size:
        return [[] for _ in matrix]
    return fmpq_mat(matrix.tolist()).solve(fmpq_mat(right.tolist())).table()


def rational(number: Fraction) -> fmpq:
    """Return the number in FLINT's exact arithmetic."""
    return fmpq(number.numerator, number.denominator)


def _residues(rows: np.ndarray) -> np.ndarray:
    """Return rational numbers as elements of the prime field."""
    residues = list(map(_residue, rows.ravel().tolist()))
    return np.array(residues, dtype=np.uint64).reshape(rows.shape)


def _residue(number: fmpq) -> int:
    return int(number.p) % field.PRIME * pow(int(number.q), -1, field.PRIME) % field.PRIME
