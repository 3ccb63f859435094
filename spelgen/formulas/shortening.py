"""A polynomial in cosines, sines and distances -> the shortest of several equal ways to write it.

Tried are, for every run of joints with parallel axes: cosines and sines of each angle, of the sums of the
angles from the first joint on (an absolute angle of the links), and multiple-angle sums of products; squares
of the sine or of the cosine; the factors of the result; and what its terms have in common.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise, product
from math import log10
from typing import Literal

from flint import fmpq, fmpq_mpoly, fmpq_mpoly_ctx

from spelgen.arm.arm import Arm
from spelgen.formulas.angles import parallel_runs, units
from spelgen.formulas.expression import Angle, Factor, Slide, Sum, Term, Trig, ordered
from spelgen.formulas.factoring import collected
from spelgen.formulas.harmonics import harmonics

_MOST_TERMS = 60
"""Longer polynomials are written as they are."""
_TRIED_FURTHER = 3

_Powers = tuple[tuple[Factor, int], ...]


@dataclass(frozen=True)
class _Candidate:
    """A polynomial whose c_k, s_k stand for the cosine and sine of ``angles[k]``."""

    polynomial: fmpq_mpoly
    angles: dict[int, Angle]


class Shortener:
    """Writes the polynomials of one arm, over c1, s1, q1, c2, ..."""

    def __init__(self, arm: Arm, context: fmpq_mpoly_ctx):
        self._n = len(arm.coordinates)
        self._context = context
        self._gens = context.gens()
        self._units = units(arm)
        self._runs = parallel_runs(arm)

    def reduced(self, polynomial: fmpq_mpoly) -> fmpq_mpoly:
        """The same function with every sine to the first power at most."""
        for joint in range(self._n):
            polynomial = self._without_square(polynomial, joint, "s")
        return polynomial

    def shortest(self, polynomial: fmpq_mpoly) -> Sum:
        """The shortest way found to write a reduced ``polynomial``."""
        plain = _Candidate(polynomial, {k: ((k, unit),) for k, unit in self._units.items()})
        if len(polynomial) > _MOST_TERMS:
            return self._expanded(plain)
        written = [self._expanded(plain)]
        for candidate in self._absolute_angles(plain):
            for squared in self._squares(candidate):
                written += [self._expanded(squared), *self._factored(squared)]
        for squared in self._squares(plain):
            written += self._multiple_angles(squared)
        best = sorted(written, key=_cost)[:_TRIED_FURTHER]
        best += [collected(expression, set(run.joints)) for expression in best for run in self._runs]
        return min(best, key=_cost)

    def _turning(self, polynomial: fmpq_mpoly) -> list[int]:
        degrees = polynomial.degrees()
        return [k for k in self._units if degrees[3 * k] or degrees[3 * k + 1]]

    def _absolute_angles(self, plain: _Candidate) -> Iterator[_Candidate]:
        """The polynomial in the angles themselves, or in their sums along each run."""
        used = set(self._turning(plain.polynomial))
        runs = []
        for run in self._runs:
            kept = [(k, sense) for k, sense in zip(run.joints, run.senses, strict=True) if k in used]
            if len(kept) > 1:
                runs.append(kept)
        for chosen in product((False, True), repeat=len(runs)):
            candidate = plain
            for kept, summed in zip(runs, chosen, strict=True):
                candidate = self._summed(candidate, kept) if summed else candidate
            yield candidate

    def _summed(self, candidate: _Candidate, run: Sequence[tuple[int, int]]) -> _Candidate:
        """With the angles of ``run`` replaced by their sums from its first joint on."""
        gens = list(self._gens)
        angles = dict(candidate.angles)
        for (before, _), (joint, own) in pairwise(run):
            sense = own * run[0][1]
            c, s, c0, s0 = (self._gens[3 * k + i] for k in (joint, before) for i in (0, 1))
            # q = sense * (sum up to here - sum before)
            gens[3 * joint] = c * c0 + s * s0
            gens[3 * joint + 1] = sense * (s * c0 - c * s0)
            angles[joint] = (*angles[before], (joint, Fraction(sense)))
        changed = candidate.polynomial.compose(*gens, ctx=self._context)
        return _Candidate(self.reduced(changed), angles)

    def _squares(self, candidate: _Candidate) -> Iterator[_Candidate]:
        """With squares of cosines, and with squares of sines wherever that is shorter."""
        yield candidate
        polynomial = candidate.polynomial
        for joint in self._turning(polynomial):
            swapped = self._without_square(polynomial, joint, "c")
            polynomial = swapped if len(swapped) < len(polynomial) else polynomial
        if len(polynomial) < len(candidate.polynomial):
            yield _Candidate(polynomial, candidate.angles)

    def _without_square(self, polynomial: fmpq_mpoly, joint: int, which: Literal["c", "s"]) -> fmpq_mpoly:
        """With c^2 + s^2 = 1 used until the variable stands to the first power at most."""
        place, other = (3 * joint, 3 * joint + 1) if which == "c" else (3 * joint + 1, 3 * joint)
        if polynomial.degrees()[place] < 2:
            return polynomial
        total = 0 * polynomial
        for exponents, coefficient in polynomial.terms():
            kept = list(exponents)
            kept[place] %= 2
            term = self._context.from_dict({tuple(kept): coefficient})
            total += term * (1 - self._gens[other] ** 2) ** (exponents[place] // 2)
        return total

    def _expanded(self, candidate: _Candidate) -> Sum:
        terms = [
            Term(_fraction(coefficient), self._monomial(exponents, candidate.angles))
            for exponents, coefficient in candidate.polynomial.terms()
        ]
        return Sum(tuple(terms))

    def _monomial(self, exponents: Sequence[int], angles: dict[int, Angle]) -> _Powers:
        factors: list[tuple[Factor, int]] = []
        for joint in range(self._n):
            cosine, sine, slide = exponents[3 * joint : 3 * joint + 3]
            factors += [(Slide(joint), slide)] if slide else []
            factors += [(Trig("cos", angles[joint]), cosine)] if cosine else []
            factors += [(Trig("sin", angles[joint]), sine)] if sine else []
        return tuple(factors)

    def _factored(self, candidate: _Candidate) -> Iterator[Sum]:
        """The product of its factors, and that with the number multiplied into a single sum among them."""
        content, parts = candidate.polynomial.factor()
        number = _fraction(content)
        single: list[tuple[Factor, int]] = []
        sums: list[tuple[Sum, int]] = []
        for part, power in parts:
            inner = self._expanded(_Candidate(part, candidate.angles))
            if len(inner.terms) == 1:
                number *= inner.terms[0].coefficient ** power
                single += [(factor, own * power) for factor, own in inner.terms[0].factors]
            else:
                # the factor's coefficients are integers: leave it what keeps the number before it near 1
                scale = Fraction(10) ** round(-_magnitude(number) / power)
                number *= scale**power
                sums.append((inner.times(1 / scale), power))
        yield Sum((Term(number, ordered((*single, *sums))),))
        if [power for _, power in sums] == [1]:
            inside = sums[0][0].times(abs(number))
            yield Sum((Term(Fraction(1 if number > 0 else -1), ordered((*single, (inside, 1)))),))

    def _multiple_angles(self, plain: _Candidate) -> Iterator[Sum]:
        """Products of cosines and sines along each run, or along all runs, as sums of multiple angles."""
        used = self._turning(plain.polynomial)
        runs = [[k for k in run.joints if k in used] for run in self._runs]
        runs = [run for run in runs if run]
        for chosen in [*([run] for run in runs), runs] if len(runs) > 1 else [runs]:
            yield self._in_multiples(plain, chosen)

    def _in_multiples(self, plain: _Candidate, runs: Sequence[Sequence[int]]) -> Sum:
        totals: dict[_Powers, Fraction] = {}
        for exponents, coefficient in plain.polynomial.terms():
            rest = list(exponents)
            for joint in (joint for run in runs for joint in run):
                rest[3 * joint] = rest[3 * joint + 1] = 0
            products: list[tuple[Fraction, _Powers]] = [
                (_fraction(coefficient), self._monomial(rest, plain.angles))
            ]
            for run in runs:
                terms = harmonics({k: (exponents[3 * k], exponents[3 * k + 1]) for k in run}, self._units)
                products = [
                    (number * coefficient, (*factors, (trig, 1)) if trig else factors)
                    for number, factors in products
                    for trig, coefficient in terms
                ]
            for number, factors in products:
                totals[ordered(factors)] = totals.get(ordered(factors), Fraction(0)) + number
        return Sum(tuple(Term(number, key) for key, number in totals.items() if number))


def _magnitude(number: Fraction) -> float:
    """log10 of its size; its digits may be more than a float holds."""
    return log10(abs(number.numerator)) - log10(number.denominator)


def _fraction(number: fmpq) -> Fraction:
    return Fraction(int(number.p), int(number.q))


def _cost(expression: Sum) -> float:
    return expression.cost
