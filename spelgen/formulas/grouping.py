"""Polynomials by base parameter -> one expression, linear in the base parameters."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

from flint import fmpq_mpoly

from spelgen.formulas.expression import Factor, Sum, Symbol, Term
from spelgen.formulas.factoring import bracketed
from spelgen.formulas.shortening import Shortener
from spelgen.structure.base_parameters import BaseParameter

Collected = list[tuple[BaseParameter, fmpq_mpoly]]
_ONE = Sum((Term(Fraction(1)),))


def grouped(shortener: Shortener, collected: Collected) -> Sum:
    """The sum over the parameters; those that are multiplied by the same function, up to a factor, together."""
    groups: dict[Sum, list[tuple[BaseParameter, Fraction]]] = {}
    for parameter, polynomial in collected:
        function = shortener.shortest(polynomial)
        leading = function.terms[0].coefficient
        groups.setdefault(function.times(1 / leading), []).append((parameter, leading))
    terms: list[Term] = []
    for unit, members in sorted(groups.items(), key=lambda group: group[0] != _ONE):  # constants first
        terms += _group(unit, members)
    whole = Sum(tuple(terms))
    size = abs(bracketed(whole)[0])
    return whole if size == 1 else Sum((Term(size, ((whole.times(1 / size), 1),)),))


def _group(unit: Sum, members: Sequence[tuple[BaseParameter, Fraction]]) -> list[Term]:
    """The terms of parameters times multiples of one function, given with 1 as its first coefficient."""
    number, factors = Fraction(1), unit.terms[0].factors
    if len(unit.terms) > 1:
        first = abs(members[0][1])
        number, inside = bracketed(unit.times(first))
        factors = ((inside, 1),)
        members = [(parameter, coefficient / first) for parameter, coefficient in members]
    each = [Term(coefficient, ((Symbol(parameter.name), 1),)) for parameter, coefficient in members]
    if len(members) == 1 or not factors:
        return [Term(number * term.coefficient, (*term.factors, *factors)) for term in each]
    coefficient, together = bracketed(Sum(tuple(each)))
    before: tuple[Factor, int] = (together, 1)
    return [Term(number * coefficient, (before, *factors))]
