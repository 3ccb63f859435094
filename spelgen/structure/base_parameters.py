"""Base inertial parameters of an arm in exact arithmetic: the smallest set of combinations that determine M and V.

Each entry of M(q), and V(q) - V(q0), is linear in the ten inertial parameters of each body; q0 is a fixed
configuration. The coefficients, with a row for each entry of M and for V, are the energy regressor. Its rows are
computed at random rational configurations; their reduced row echelon form gives the base parameters. Gautier and
Khalil, *Direct calculation of minimum set of inertial parameters of serial robots*, IEEE Trans. Robotics and Automation
6(3), 1990, derive the same parameters by symbolic rules.
"""

import random
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache

import numpy as np
from flint import fmpq, fmpq_mat

from spelgen.arm.arm import Chain
from spelgen.labels import BASE_ORDER, INERTIAL_PARAMETERS, base_name, parameter_name
from spelgen.structure import field
from spelgen.structure.recursion import Position, coefficients
from spelgen.structure.sampling import regressor_rows


@dataclass(frozen=True)
class BaseParameter:
    """A base parameter: a linear combination of inertial parameters that can be identified from the motion.

    Parameter i of a body, in the order of ``INERTIAL_PARAMETERS``, has the index 10 body + i.

    Attributes:
        name: name of the first inertial parameter of the combination, with the suffix R if there are others.
        index: index of the first inertial parameter.
        weights: pairs (index, coefficient) of the inertial parameters; the first coefficient is 1.
        value: value for the inertials of the URDF; None if a body of the combination has no inertial.
    """

    name: str
    index: int
    weights: tuple[tuple[int, Fraction], ...]
    value: Fraction | None


@lru_cache(maxsize=16)
def base_parameter_count(arm: Chain) -> int:
    """Return the number of base parameters: the rank of the energy regressor at random positions.

    The regressor has rows for V(q) and for each entry of M(q), and needs no velocities (see the module).
    """
    points = 7  # Enough random positions for most arms of at most seven joints; the loop doubles them.
    while True:
        rows = regressor_rows(arm, points + 2)
        rank = field.rank(rows)
        # If two more positions do not raise the rank, it is the final rank, with negligible probability of an error.
        if field.rank(rows[: len(rows) * points // (points + 2)]) == rank:
            return rank
        points *= 2


# The base parameters of an arm are cached, since least squares, checks of logs and closed forms all need them.
@lru_cache(maxsize=16)
def base_parameters(arm: Chain) -> tuple[BaseParameter, ...]:
    """Return the base parameters of ``arm``, in the order of the bodies from the root."""
    indices = [INERTIAL_PARAMETERS.index(name) for name in BASE_ORDER]
    order = [10 * body + offset for body in range(len(arm.bodies)) for offset in indices]
    result = []
    for row in _reduced_rows(arm, order):
        pairs = zip(order, row, strict=True)
        weights = tuple((index, Fraction(int(x.p), int(x.q))) for index, x in pairs if x)
        # The first nonzero element of a row of the echelon form is its pivot, which is 1: it is the coefficient of the
        # first inertial parameter of the combination.
        first, _ = weights[0]
        name = base_name(parameter_name(first), len(weights))
        result.append(BaseParameter(name, first, weights, _value(arm, weights)))
    return tuple(result)


def _value(arm: Chain, weights: Sequence[tuple[int, Fraction]]) -> Fraction | None:
    """Return the value of a base parameter for the inertials of the URDF; None if one of its bodies has no inertial.

    weights: pairs (index of an inertial parameter, coefficient).
    """
    total = Fraction(0)
    for index, coefficient in weights:
        inertia = arm.bodies[index // 10].inertia
        if inertia is None:
            return None
        total += coefficient * inertia[index % 10]
    return total


def _reduced_rows(arm: Chain, order: list[int]) -> list[list[fmpq]]:
    """Return the reduced row echelon form of the energy regressor, (base parameters, 10 B) for B bodies.

    order: column k of the result is the inertial parameter with the index order[k].
    """
    generator = random.Random(0)
    # A constant in V has no effect on the motion: the row of V at the first configuration is subtracted from others.
    reference = _rows(arm, generator)[-1]
    basis: list[list[fmpq]] = []
    while len(basis) < base_parameter_count(arm):
        rows = _rows(arm, generator)
        rows[-1] -= reference
        echelon, rank = fmpq_mat(basis + rows[:, order].tolist()).rref()
        basis = echelon.table()[:rank]
    return basis


def _rows(arm: Chain, generator: random.Random) -> np.ndarray:
    """Return the energy regressor at a random configuration: (n(n+1)/2 + 1, 10 B) for n joints and B bodies.

    A row has the coefficients of the inertial parameters in an entry of M; the last row, in the potential energy V. The
    elements are rational numbers of FLINT (fmpq). generator: source of the random configuration.
    """
    parameters = 10 * len(arm.bodies)
    positions = []
    for _ in arm.coordinates:
        t, value = (fmpq(generator.randrange(1, 1000), generator.randrange(1, 1000)) for _ in range(2))
        # t is the rational tangent of half the joint angle, so that its cosine and sine are rational.
        norm = 1 + t * t
        positions.append(Position((1 - t * t) / norm, 2 * t / norm, value))
    units = list(np.eye(parameters, dtype=int).astype(object))
    elements = coefficients(arm, positions, units, rational)
    # For an entry of M that is always zero the recursion returns the integer 0, which is expanded to a row of zeros.
    return np.stack([np.broadcast_to(element, parameters) for element in elements])


def rational(number: Fraction) -> fmpq:
    """Return the fraction as a rational number of FLINT, for which arithmetic is faster than for `Fraction`."""
    return fmpq(number.numerator, number.denominator)
