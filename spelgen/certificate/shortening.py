"""Write a polynomial in cosines, sines and distances the shortest of several equal candidates.

Tried are: cosines and sines of each angle, or multiple-angle sums of products along runs of joints with parallel
axes; and then what terms have in common. Multiple angles of one run alone, of squares, common factors of the second
best, and squares of the sine for those of the cosine were tried too: they made formulas 0.4 and 0.9 % shorter.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

from flint import fmpq, fmpq_mpoly, fmpq_mpoly_ctx
from sympy import Expr, Rational, cos, sin

from spelgen.arm.arm import Arm
from spelgen.certificate.angles import multiple_angles, parallel_runs
from spelgen.certificate.terms import Factors, Terms, collected, coordinate, length, ordered
from spelgen.settings.tuning.structure import CertificateTuning
from spelgen.structure.sampling import base_denominators

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
