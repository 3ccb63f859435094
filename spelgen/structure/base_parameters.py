"""The base inertial parameters of an arm, exactly: the fewest combinations that M and V are linear in.

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
    """A combination of inertial parameters that the motion depends on.

    ``name`` is that of its first parameter, with an R where others are regrouped into it; ``weights`` are
    (parameter, coefficient), parameters counted 10 body + i in the order of ``PARAMETERS``. ``value`` is the
    URDF's, None where a body has no inertial.
    """

    name: str
    index: int
    weights: tuple[tuple[int, Fraction], ...]
    value: Fraction | None


def parameter_name(index: int) -> str:
    """``Izz2`` is the tensor component zz of the second body."""
    return f"{PARAMETERS[index % 10]}{index // 10 + 1}"


@lru_cache(maxsize=16)  # of one arm they are asked for by least squares, logs and closed forms
def base_parameters(arm: Arm, count: int) -> tuple[BaseParameter, ...]:
    """The ``count`` base parameters of ``arm``, by body from the root."""
    order = [10 * body + PARAMETERS.index(name) for body in range(len(arm.bodies)) for name in _PREFERRED]
    rows = np.concatenate(list(_enough_rows(arm, count)))[:, order]
    residues = np.array([[_residue(x) for x in row] for row in rows], dtype=np.uint64)
    bound = field.pivots(field.row_basis(residues))
    chosen = field.pivots(field.row_basis(residues[:, bound].T))
    free = [column for column in range(len(order)) if column not in set(bound) and rows[:, column].any()]
    coefficients = _solved(rows[np.ix_(chosen, bound)], rows[np.ix_(chosen, free)])
    found = []
    for place, pivot in enumerate(bound):
        weights = [(order[pivot], Fraction(1))]
        weights += [
            (order[column], Fraction(int(coefficient.p), int(coefficient.q)))
            for column, coefficient in zip(free, coefficients[place], strict=True)
            if coefficient
        ]
        name = parameter_name(order[pivot]) + ("R" if len(weights) > 1 else "")
        found.append(BaseParameter(name, order[pivot], tuple(weights), _value(arm, weights)))
    return tuple(found)


def _value(arm: Arm, weights: list[tuple[int, Fraction]]) -> Fraction | None:
    total = Fraction(0)
    for index, coefficient in weights:
        inertia = arm.bodies[index // 10].inertia
        if inertia is None:
            return None
        total += coefficient * inertia[index % 10]
    return total


def _enough_rows(arm: Arm, count: int) -> list[np.ndarray]:
    """Coefficient rows at as many random configurations as it takes to have rank ``count``."""
    generator = random.Random(0)
    gathered = field.Independent(10 * len(arm.bodies))
    reference = _rows(arm, generator)[-1]
    blocks: list[np.ndarray] = []
    while len(gathered.rows) < count:
        rows = _rows(arm, generator)
        rows[-1] = rows[-1] - reference  # a constant part of V moves nothing
        for row in rows:
            gathered.add(np.array([_residue(x) for x in row], dtype=np.uint64))
        blocks.append(rows)
    return blocks


def _rows(arm: Arm, generator: random.Random) -> np.ndarray:
    """Coefficients of M's entries and of V at one random configuration, (n(n+1)/2 + 1, 10 bodies) of fmpq."""
    n, parameters = len(arm.coordinates), 10 * len(arm.bodies)
    positions = []
    for _ in range(n):
        t, value = (fmpq(generator.randrange(1, _GRID), generator.randrange(1, _GRID)) for _ in range(2))
        positions.append(Position((1 - t * t) / (1 + t * t), 2 * t / (1 + t * t), value))
    zero, one = fmpq(0), fmpq(1)
    units = np.array([[one if i == j else zero for j in range(parameters)] for i in range(parameters)])
    inertias = [list(units[10 * body : 10 * body + 10]) for body in range(len(arm.bodies))]
    result = energies(arm, motions(arm, positions, _rational), inertias, _rational)
    elements = [result.mass[key] for key in triangle(n)] + [result.potential]
    return np.array([x if isinstance(x, np.ndarray) else np.full(parameters, zero) for x in elements])


def _solved(left: np.ndarray, right: np.ndarray) -> list[list[fmpq]]:
    if not right.size:
        return [[] for _ in left]
    return fmpq_mat(left.tolist()).solve(fmpq_mat(right.tolist())).table()


def _rational(number: Fraction) -> fmpq:
    return fmpq(number.numerator, number.denominator)


def _residue(number: fmpq) -> int:
    return int(number.p) % field.PRIME * pow(int(number.q), -1, field.PRIME) % field.PRIME
