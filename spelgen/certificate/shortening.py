"""Write a polynomial in cosines, sines and distances the shortest of several equal candidates.

Tried are: cosines and sines of each angle, and multiple-angle sums of products along runs of joints with parallel
axes; squares of the sine or of the cosine; and what terms have in common. Sums of angles before products, and
factors of the whole, were tried too: over 40 arms they made formulas 0.9 % shorter.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain, product

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
            polynomial = self._without_square(polynomial, 3 * joint + 1, 3 * joint)
        return polynomial

    def shortest(self, polynomial: fmpq_mpoly) -> Terms:
        """Return the shortest way to write a reduced ``polynomial``; long ones are written as they are."""
        plain = self._expanded(polynomial)
        if len(polynomial) > TUNING.most_terms_shortened:
            return plain
        candidates = [plain]
        # s^2 for 1 - c^2 often merges two terms, and never changes the value
        squares_of_sines = self._with_sines_squared(polynomial)
        if len(squares_of_sines) < len(polynomial):
            candidates.append(self._expanded(squares_of_sines))
            candidates += self._multiple_angles(squares_of_sines)
        candidates += self._multiple_angles(polynomial)
        # collecting is the slow step, so it goes on from the shortest few
        candidates = sorted(candidates, key=length)[: TUNING.ways_collected]
        for terms in list(candidates):
            for run in self._runs:
                candidates.append(collected(terms, set(run)))
        return min(candidates, key=length)

    def _with_sines_squared(self, polynomial: fmpq_mpoly) -> fmpq_mpoly:
        """Return it with squares of sines in place of those of cosines wherever that is shorter."""
        for joint in self._angles:
            swapped = self._without_square(polynomial, 3 * joint, 3 * joint + 1)
            if len(swapped) < len(polynomial):
                polynomial = swapped
        return polynomial

    def _without_square(self, polynomial: fmpq_mpoly, variable: int, partner: int) -> fmpq_mpoly:
        """Use c^2 + s^2 = 1 until ``variable`` stands to the first power at most."""
        if polynomial.degrees()[variable] < 2:
            return polynomial
        total = 0 * polynomial
        for exponents, coefficient in polynomial.terms():
            powers = list(exponents)
            powers[variable] %= 2
            term = self._context.from_dict({tuple(powers): coefficient})
            total += term * (1 - self._gens[partner] ** 2) ** (exponents[variable] // 2)
        return total

    def _expanded(self, polynomial: fmpq_mpoly) -> Terms:
        terms: Terms = {}
        for exponents, coefficient in polynomial.terms():
            terms[self._monomial(exponents)] = coefficient
        return terms

    def _turning(self, polynomial: fmpq_mpoly) -> list[list[int]]:
        """Return the runs, of the joints alone whose cosine or sine is in ``polynomial``."""
        degrees = polynomial.degrees()
        runs = []
        for run in self._runs:
            turning = [joint for joint in run if degrees[3 * joint] or degrees[3 * joint + 1]]
            if turning:
                runs.append(turning)
        return runs

    def _multiple_angles(self, polynomial: fmpq_mpoly) -> Iterator[Terms]:
        """Yield products of cosines and sines along each run, and along all runs, as sums of multiple angles."""
        runs = self._turning(polynomial)
        for run in runs:
            yield self._with_multiple_angles(polynomial, [run])
        # with one run the line above yielded the same already
        if len(runs) != 1:
            yield self._with_multiple_angles(polynomial, runs)

    def _with_multiple_angles(self, polynomial: fmpq_mpoly, runs: Sequence[Sequence[int]]) -> Terms:
        result: Terms = {}
        for exponents, coefficient in polynomial.terms():
            remaining = list(exponents)
            sums = []
            for run in runs:
                sums.append(multiple_angles([(self._angles[k], *exponents[3 * k : 3 * k + 2]) for k in run]))
                for joint in run:
                    remaining[3 * joint] = remaining[3 * joint + 1] = 0
            monomial = self._monomial(remaining)
            for terms in product(*sums):
                factors = ordered([*monomial, *chain.from_iterable(function for function, _ in terms)])
                value = coefficient
                for _, number in terms:
                    value *= number
                result[factors] = result.get(factors, fmpq(0)) + value
        return {factors: value for factors, value in result.items() if value != 0}

    def _monomial(self, exponents: Sequence[int]) -> Factors:
        factors: list[Expr] = []
        for joint, angle in self._angles.items():
            bases = (cos(angle, evaluate=False), sin(angle, evaluate=False), coordinate(joint))
            for base, power in zip(bases, exponents[3 * joint :], strict=False):
                if power:
                    factors.append(base**power)
        return tuple(factors)
