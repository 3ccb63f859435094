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
from spelgen.structure.recursion import PARAMETERS, Position, coefficients
from spelgen.structure.sampling import regressor_rows

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


@lru_cache(maxsize=16)
def base_parameter_count(arm: Arm) -> int:
    """Return the rank of the inverse-dynamics regressor.

    So many combinations of inertial parameters move the arm differently.
    """
    points = 7  # enough for all but few arms of up to seven joints
    while True:
        rows = regressor_rows(arm, points + 2)
        found = field.rank(rows)
        # the rows of the last points would have raised an unfinished rank, all but surely
        if field.rank(rows[: len(rows) * points // (points + 2)]) == found:
            return found
        points *= 2


@lru_cache(maxsize=16)  # of one arm they are asked for by least squares, logs and closed forms
def base_parameters(arm: Arm) -> tuple[BaseParameter, ...]:
    """Return the base parameters of ``arm``, by body from the root."""
    order: list[int] = []
    for body in range(len(arm.bodies)):
        order += [10 * body + PARAMETERS.index(name) for name in _PREFERRED]
    result = []
    for row in _reduced_rows(arm, order):
        weights = []
        for index, coefficient in zip(order, row, strict=True):
            if coefficient:
                weights.append((index, Fraction(int(coefficient.p), int(coefficient.q))))
        # a row of an echelon form is 1 at its first parameter
        first, _ = weights[0]
        name = parameter_name(first)
        if len(weights) > 1:
            name += "R"
        result.append(BaseParameter(name, first, tuple(weights), _value(arm, weights)))
    return tuple(result)


def _value(arm: Arm, weights: list[tuple[int, Fraction]]) -> Fraction | None:
    total = Fraction(0)
    for index, coefficient in weights:
        inertia = arm.bodies[index // 10].inertia
        if inertia is None:
            return None
        total += coefficient * inertia[index % 10]
    return total


def _reduced_rows(arm: Arm, order: list[int]) -> list[list[fmpq]]:
    """Return the reduced echelon form of all coefficients, its columns in this order."""
    generator = random.Random(0)
    # a constant part of V moves nothing: V counts from where it is here
    reference = _rows(arm, generator)[-1]
    basis: list[list[fmpq]] = []
    while len(basis) < base_parameter_count(arm):
        rows = _rows(arm, generator)
        rows[-1] -= reference
        echelon, rank = fmpq_mat(basis + rows[:, order].tolist()).rref()
        basis = echelon.table()[:rank]
    return basis


def _rows(arm: Arm, generator: random.Random) -> np.ndarray:
    """Return coefficients of M's entries and of V at one random configuration, (n(n+1)/2 + 1, 10 bodies) of fmpq."""
    parameters = 10 * len(arm.bodies)
    positions = []
    for _ in arm.coordinates:
        t = fmpq(generator.randrange(1, _GRID), generator.randrange(1, _GRID))
        value = fmpq(generator.randrange(1, _GRID), generator.randrange(1, _GRID))
        # t is the tangent of half the angle, so that cosine and sine are rational
        norm = 1 + t * t
        positions.append(Position((1 - t * t) / norm, 2 * t / norm, value))
    units = list(np.eye(parameters, dtype=int).astype(object))
    elements = coefficients(arm, positions, units, rational)
    # where nothing moves an element is a plain 0
    return np.stack([np.broadcast_to(element, parameters) for element in elements])


def rational(number: Fraction) -> fmpq:
    """Return the number in FLINT's exact arithmetic."""
    return fmpq(number.numerator, number.denominator)
