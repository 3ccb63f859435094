"""Numbers and common factors taken out of sums."""

from __future__ import annotations

from collections.abc import Set
from fractions import Fraction

from spelgen.formulas.expression import Factor, Slide, Sum, Term, Trig, ordered


def bracketed(expression: Sum) -> tuple[Fraction, Sum]:
    """A number and a sum, of which ``expression`` is the product.

    A size stands before the brackets only where it leaves none inside, else no more than a sign.
    """
    sizes = {abs(term.coefficient) for term in expression.terms}
    if len(expression.terms) < 2:
        return Fraction(1), expression
    size = sizes.pop() if len(sizes) == 1 else Fraction(1)
    number = size if expression.terms[0].coefficient > 0 else -size
    return number, expression.times(1 / number)


def collected(expression: Sum, joints: Set[int]) -> Sum:
    """The terms with the same factors of other joints as one: these factors times a sum over ``joints``."""
    groups: dict[tuple[tuple[Factor, int], ...], list[Term]] = {}
    for term in expression.terms:
        inner = tuple(each for each in term.factors if _joints(each[0]) <= joints)
        outer = tuple(each for each in term.factors if each not in inner)
        groups.setdefault(outer, []).append(Term(term.coefficient, inner))
    terms: list[Term] = []
    for outer, group in groups.items():
        if len(group) == 1 or not outer:
            terms += [Term(term.coefficient, ordered((*term.factors, *outer))) for term in group]
        else:
            number, inside = bracketed(Sum(tuple(group)))
            terms.append(Term(number, (*outer, (inside, 1))))
    return Sum(tuple(terms))


def _joints(factor: Factor) -> set[int]:
    if isinstance(factor, Slide):
        return {factor.joint}
    return {joint for joint, _ in factor.angle} if isinstance(factor, Trig) else set()
