"""Exact polynomials of M(q) and V(q) in cosines and sines of angles and in sliding distances.

The recursion over bodies is the package's, evaluated in polynomials with rational coefficients. The derivation of
structure does not use polynomials (``structure`` evaluates M and V at points only), so the two are independent.
Closed forms are expanded one parameter at a time (``expansion``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

from flint import Ordering, fmpq, fmpq_mpoly, fmpq_mpoly_ctx

from spelgen.arm.arm import Chain
from spelgen.labels import INERTIAL_PARAMETERS
from spelgen.structure.basis import Weights
from spelgen.structure.recursion import Position, energies


@dataclass(frozen=True)
class Polynomials:
    """The lower triangle of M(q), by (row, column), and V(q), as polynomials over the variables ``names``.

    c1, s1 are the cosine and sine of coordinate 1, q1 its value if it slides. If a mimic joint turns by a fraction of
    coordinate 1, c1 and s1 belong to an angle such as q1 / 2, of which both joint angles are integer multiples.
    m1, hx1, ... Izz1 are the inertial parameters of body 1 about its joint, if inertial parameters are variables.
    """

    names: tuple[str, ...]
    mass: dict[tuple[int, int], fmpq_mpoly]
    potential: fmpq_mpoly

    def combination(self, weights: Weights) -> fmpq_mpoly:
        """Return a weighted sum of entries of M; weights: (row, column, weight) per entry."""
        total = 0 * self.potential
        for row, column, value in weights:
            total += _rational(value) * self.mass[row, column]
        return total


def polynomials(arm: Chain, *, inertials: bool = False) -> Polynomials:
    """Return the exact polynomials of M and V of ``arm``.

    inertials: if True, the URDF's inertial parameters are inserted as numbers; otherwise they are variables.
    """
    n, bodies = len(arm.coordinates), len(arm.bodies)
    names = [f"{letter}{k + 1}" for k in range(n) for letter in "csq"]
    if not inertials:
        names += [f"{parameter}{body + 1}" for body in range(bodies) for parameter in INERTIAL_PARAMETERS]
    context = fmpq_mpoly_ctx.get(names, Ordering.lex)
    variables = context.gens()
    positions = [Position(*variables[3 * k : 3 * k + 3]) for k in range(n)]
    one = context.from_dict({(0,) * len(names): 1})
    parameters: list[Sequence[fmpq_mpoly]]
    if inertials:
        parameters = [
            [_rational(x) * one for x in body.inertia or (Fraction(0),) * 10] for body in arm.bodies
        ]
    else:
        parameters = [variables[3 * n + 10 * body :][:10] for body in range(bodies)]
    result = energies(arm, positions, parameters, _rational)
    mass = {key: _reduced(value * one, n) for key, value in result.mass.items()}
    return Polynomials(tuple(names), mass, _reduced(result.potential * one, n))


def _rational(number: Fraction) -> fmpq:
    return fmpq(number.numerator, number.denominator)


def _reduced(polynomial: fmpq_mpoly, n: int) -> fmpq_mpoly:
    """Return an equal polynomial in which the sine of each of n coordinates has at most the power one.

    s^2 is replaced by 1 - c^2. The recursion already does so for the rotation of a single joint. Higher powers occur
    only in arms with mimic joints, for example in products of the rotations of two joints with the same coordinate.
    """
    context = polynomial.context()
    for k in range(n):
        cosine = context.gens()[3 * k]
        while polynomial.degrees()[3 * k + 1] > 1:
            total = 0 * polynomial
            for exponents, coefficient in polynomial.terms():
                power = exponents[3 * k + 1]
                kept = list(exponents)
                kept[3 * k + 1] = power % 2
                term = context.from_dict({tuple(kept): coefficient})
                total += term * (1 - cosine * cosine) ** (power // 2)
            polynomial = total
    return polynomial
