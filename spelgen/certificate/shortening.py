"""A polynomial in cosines, sines and distances -> the shortest of several equal ways to write it.

Tried are, for every run of joints with parallel axes: cosines and sines of each angle, of the sums of the
angles from the first joint on (an absolute angle of the links), and multiple-angle sums of products; squares
of the sine or of the cosine; the factors of the result; and what its terms have in common.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, pairwise, product
from math import log10, prod
from typing import NamedTuple

from flint import fmpq, fmpq_mpoly, fmpq_mpoly_ctx
from sympy import Add, Expr, Pow, Rational, cos, sin

from spelgen.arm.arm import Arm
from spelgen.certificate.angles import multiple_angles, parallel_runs
from spelgen.certificate.terms import (
    Factors,
    Terms,
    collected,
    coordinate,
    expression,
    length,
    ordered,
    times,
)
from spelgen.structure.sampling import base_denominators

_MOST_TERMS = 60
"""Longer polynomials are written as they are."""
_TRIED_FURTHER = 3


class _Candidate(NamedTuple):
    """A polynomial whose c_k, s_k stand for the cosine and sine of ``angles[k]``."""

    polynomial: fmpq_mpoly
    angles: Mapping[int, Expr]


class Shortener:
    """Writes the polynomials of one arm, over c1, s1, q1, c2, ..."""

    def __init__(self, arm: Arm, context: fmpq_mpoly_ctx):
        self._context = context
        self._gens = context.gens()
        # mimic joints may turn by fractions of a coordinate
        self._angles = {k: Rational(1, d) * coordinate(k) for k, d in enumerate(base_denominators(arm))}
        self._runs = parallel_runs(arm)

    def reduced(self, polynomial: fmpq_mpoly) -> fmpq_mpoly:
        """The same function with every sine to the first power at most."""
        for joint in self._angles:
            polynomial = self._without_square(polynomial, 3 * joint + 1, 3 * joint)
        return polynomial

    def shortest(self, polynomial: fmpq_mpoly) -> Terms:
        """The shortest way found to write a reduced ``polynomial``."""
        plain = _Candidate(polynomial, self._angles)
        written = [self._expanded(plain)]
        if len(polynomial) > _MOST_TERMS:
            return written[0]
        for candidate in self._absolute_angles(plain):
            for squared in self._squares(candidate):
                written += [self._expanded(squared), *self._factored(squared)]
        for squared in self._squares(plain):
            written += self._multiple_angles(squared.polynomial)
        best = sorted(written, key=length)[:_TRIED_FURTHER]
        best += [collected(terms, run.keys()) for terms in best for run in self._runs]
        return min(best, key=length)

    def _turning(self, polynomial: fmpq_mpoly) -> list[dict[int, int]]:
        """The runs of the joints whose cosine or sine is in ``polynomial``."""
        degrees = polynomial.degrees()
        runs = [{k: run[k] for k in run if degrees[3 * k] or degrees[3 * k + 1]} for run in self._runs]
        return [run for run in runs if run]

    def _absolute_angles(self, plain: _Candidate) -> Iterator[_Candidate]:
        """The polynomial in the angles themselves, or in their sums along each run."""
        runs = [run for run in self._turning(plain.polynomial) if len(run) > 1]
        for chosen in product((False, True), repeat=len(runs)):
            candidate = plain
            for run, summed in zip(runs, chosen, strict=True):
                candidate = self._summed(candidate, run) if summed else candidate
            yield candidate

    def _summed(self, candidate: _Candidate, run: Mapping[int, int]) -> _Candidate:
        """With the angles of ``run`` replaced by their sums from its first joint on."""
        gens, angles = list(self._gens), dict(candidate.angles)
        for before, joint in pairwise(run):
            sense = run[joint] * run[min(run)]
            c, s, c0, s0 = (self._gens[3 * k + i] for k in (joint, before) for i in (0, 1))
            # q = sense * (sum up to here - sum before)
            gens[3 * joint] = c * c0 + s * s0
            gens[3 * joint + 1] = sense * (s * c0 - c * s0)
            angles[joint] = Add(*Add.make_args(angles[before]), sense * coordinate(joint), evaluate=False)
        return _Candidate(self.reduced(candidate.polynomial.compose(*gens, ctx=self._context)), angles)

    def _squares(self, candidate: _Candidate) -> Iterator[_Candidate]:
        """With squares of cosines, and with squares of sines wherever that is shorter."""
        yield candidate
        polynomial = candidate.polynomial
        for joint in chain(*self._turning(polynomial)):
            swapped = self._without_square(polynomial, 3 * joint, 3 * joint + 1)
            polynomial = swapped if len(swapped) < len(polynomial) else polynomial
        if len(polynomial) < len(candidate.polynomial):
            yield _Candidate(polynomial, candidate.angles)

    def _without_square(self, polynomial: fmpq_mpoly, place: int, other: int) -> fmpq_mpoly:
        """With c^2 + s^2 = 1 used until the variable at ``place`` stands to the first power at most."""
        if polynomial.degrees()[place] < 2:
            return polynomial
        total = 0 * polynomial
        for exponents, coefficient in polynomial.terms():
            kept = (*exponents[:place], exponents[place] % 2, *exponents[place + 1 :])
            term = self._context.from_dict({kept: coefficient})
            total += term * (1 - self._gens[other] ** 2) ** (exponents[place] // 2)
        return total

    def _expanded(self, candidate: _Candidate) -> Terms:
        terms = candidate.polynomial.terms()
        return {_monomial(exponents, candidate.angles): coefficient for exponents, coefficient in terms}

    def _factored(self, candidate: _Candidate) -> Iterator[Terms]:
        """The product of its factors, and that with the number multiplied into a single sum among them."""
        number, parts = candidate.polynomial.factor()
        single: list[Expr] = []
        sums: list[tuple[Terms, int]] = []
        for part, power in parts:
            inner = self._expanded(_Candidate(part, candidate.angles))
            if len(inner) == 1:
                [(factors, own)] = inner.items()
                number *= own**power
                single += [factor**power for factor in factors]
            else:
                # the factor's coefficients are integers: leave it what keeps the number before it near 1
                scale = fmpq(10) ** round(-_magnitude(number) / power)
                number *= scale**power
                sums.append((times(inner, 1 / scale), power))
        brackets = [(expression(inner), power) for inner, power in sums]
        powers = [base if power == 1 else Pow(base, power, evaluate=False) for base, power in brackets]
        yield {(*ordered(single), *powers): number}
        if [power for _, power in sums] == [1]:
            inside = expression(times(sums[0][0], abs(number)))
            yield {(*ordered(single), inside): fmpq(1 if number > 0 else -1)}

    def _multiple_angles(self, polynomial: fmpq_mpoly) -> Iterator[Terms]:
        """Products of cosines and sines along each run, or along all runs, as sums of multiple angles."""
        runs = self._turning(polynomial)
        for chosen in [*([run] for run in runs), runs] if len(runs) > 1 else [runs]:
            found: Terms = {}
            for exponents, coefficient in polynomial.terms():
                rest = list(exponents)
                for k in chain(*chosen):
                    rest[3 * k] = rest[3 * k + 1] = 0
                angles = [[(self._angles[k], *exponents[3 * k : 3 * k + 2]) for k in run] for run in chosen]
                for picked in product(*map(multiple_angles, angles)):
                    factors = ordered(sum((trig for trig, _ in picked), _monomial(rest, self._angles)))
                    value = prod((number for _, number in picked), start=coefficient)
                    found[factors] = found.get(factors, 0) + value
            yield {factors: value for factors, value in found.items() if value != 0}


def _monomial(exponents: Sequence[int], angles: Mapping[int, Expr]) -> Factors:
    factors: list[Expr] = []
    for place, power in enumerate(exponents):
        if power:
            joint, kind = divmod(place, 3)
            base = coordinate(joint) if kind == 2 else (cos, sin)[kind](angles[joint], evaluate=False)
            factors.append(base**power)
    return tuple(factors)


def _magnitude(number: fmpq) -> float:
    """log10 of its size; its digits may be more than a float holds."""
    return log10(abs(int(number.p))) - log10(int(number.q))
