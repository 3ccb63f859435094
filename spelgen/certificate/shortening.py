"""Write a polynomial in cosines, sines and distances the shortest of several equal candidates.

Tried are: cosines and sines of each angle, or multiple-angle sums of products along runs of joints with parallel
axes; and then what terms have in common. Multiple angles of one run alone, of squares, common factors of the second
best, and squares of the sine for those of the cosine were tried too: they made formulas 0.4 and 0.9 % shorter.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

from flint import fmpq, fmpq_mpoly, fmpq_mpoly_ctx, fmpz_poly
from sympy import Add, Expr, Rational, cos, sin

from spelgen.arm.arm import Arm
from spelgen.certificate.axes import Axes, is_plain
from spelgen.certificate.terms import Factors, Terms, collected, coordinate, length, ordered
from spelgen.settings.tuning.structure import CertificateTuning
from spelgen.structure.recursion import base_denominators

TUNING = CertificateTuning()


class Shortener:
    """Write the polynomials of one arm, over c1, s1, q1, c2, ..."""

    def __init__(self, arm: Arm, context: fmpq_mpoly_ctx):
        self._context = context
        self._gens = context.gens()
        self._angles: dict[int, Expr] = {}
        for joint, denominator in enumerate(base_denominators(arm)):
            # mimic joints may turn by fractions of a coordinate
            self._angles[joint] = Rational(1, denominator) * coordinate(joint)
        self._runs = parallel_runs(arm)

    def reduced(self, polynomial: fmpq_mpoly) -> fmpq_mpoly:
        """Return the same function with every sine to the first power at most."""
        for joint in self._angles:
            cosine, sine = self._gens[3 * joint], 3 * joint + 1
            if polynomial.degrees()[sine] < 2:
                continue
            total = 0 * polynomial
            for exponents, coefficient in polynomial.terms():
                powers = list(exponents)
                powers[sine] %= 2
                term = self._context.from_dict({tuple(powers): coefficient})
                total += term * (1 - cosine**2) ** (exponents[sine] // 2)
            polynomial = total
        return polynomial

    def shortest(self, polynomial: fmpq_mpoly) -> Terms:
        """Return the shortest way to write a reduced ``polynomial``; long ones are written as they are."""
        plain = self._expanded(polynomial)
        if len(polynomial) > TUNING.most_terms_shortened:
            return plain
        sum_of_products = min(plain, self._multiple_angles(polynomial), key=length)
        candidates = [sum_of_products]
        for run in self._runs:
            candidates.append(collected(sum_of_products, set(run)))
        return min(candidates, key=length)

    def _expanded(self, polynomial: fmpq_mpoly) -> Terms:
        terms: Terms = {}
        for exponents, coefficient in polynomial.terms():
            terms[self._monomial(exponents)] = coefficient
        return terms

    def _multiple_angles(self, polynomial: fmpq_mpoly) -> Terms:
        """Return it with products of cosines and sines along each run as sums of multiple angles."""
        result: Terms = {}
        for exponents, coefficient in polynomial.terms():
            remaining = list(exponents)
            sums = []
            for run in self._runs:
                powers = []
                for joint in run:
                    powers.append((self._angles[joint], *exponents[3 * joint : 3 * joint + 2]))
                    remaining[3 * joint] = remaining[3 * joint + 1] = 0
                sums.append(multiple_angles(powers))
            monomial = self._monomial(remaining)
            for terms in product(*sums):
                factors = list(monomial)
                value = coefficient
                for function, number in terms:
                    factors += function
                    value *= number
                key = ordered(factors)
                result[key] = result.get(key, fmpq(0)) + value
        return {factors: value for factors, value in result.items() if value != 0}

    def _monomial(self, exponents: Sequence[int]) -> Factors:
        factors: list[Expr] = []
        for joint, angle in self._angles.items():
            bases = (cos(angle, evaluate=False), sin(angle, evaluate=False), coordinate(joint))
            for base, power in zip(bases, exponents[3 * joint :], strict=False):
                if power:
                    factors.append(base**power)
        return tuple(factors)


def parallel_runs(arm: Arm) -> list[list[int]]:
    """Return the turning coordinates by runs of axes that are parallel however the arm moves.

    Where bodies share coordinates, each is a run of its own.
    """
    turning = sorted({body.coordinate for body in arm.bodies if body.kind == "revolute"})
    if not is_plain(arm):
        return [[joint] for joint in turning]
    axes = Axes(arm)
    runs: list[list[int]] = []
    for joint in turning:
        if runs and axes.parallel(joint, runs[-1][-1]):
            runs[-1].append(joint)
        else:
            runs.append([joint])
    return runs


def multiple_angles(powers: Sequence[tuple[Expr, int, int]]) -> list[tuple[Factors, fmpq]]:
    """Return the product of powers of cosine and sine, given as (angle, power of cos, power of sin), as a sum.

    Each term is a multiple of one or of a cosine or sine of a sum of the angles.
    """
    # cos = (e + 1/e) / 2 and sin = (e - 1/e) / 2i with e = exp(iq): coefficients by powers of e, from the highest
    spectra = []
    scale = fmpq(1)
    sines = 0
    for _, cosine, sine in powers:
        polynomial = fmpz_poly([1, 0, 1]) ** cosine * fmpz_poly([-1, 0, 1]) ** sine
        degree = polynomial.degree()  # twice the highest multiple of the angle
        spectra.append([(k - degree // 2, int(polynomial[k])) for k in range(degree, -1, -2)])
        scale /= 2 ** (cosine + sine)
        sines += sine
    function = cos
    if sines % 2:
        function = sin
    scale *= (-1) ** (sines // 2)
    result: list[tuple[Factors, fmpq]] = []
    for harmonic in product(*spectra):
        coefficient = scale
        multiples = []
        for (angle, _, _), (multiple, number) in zip(powers, harmonic, strict=True):
            coefficient *= number
            if multiple:
                multiples.append((multiple, angle))
        # odd powers leave gaps in the spectrum
        if coefficient == 0:
            continue
        if not multiples:
            result.append(((), coefficient))
        elif multiples[0][0] > 0:  # a harmonic and its opposite, at minus the angle, add up
            total = Add(*(multiple * angle for multiple, angle in multiples), evaluate=False)
            result.append(((function(total, evaluate=False),), 2 * coefficient))
    return result
