"""Handle sums of products on their way to a short form: their length to read, and the SymPy expression they become.

SymPy evaluated would undo what is chosen here, as it makes 2*(a + b) into 2*a + 2*b; so nothing is evaluated.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence, Set
from functools import cache, lru_cache
from math import inf

from flint import fmpq
from sympy import Add, Expr, Mul, Rational, Symbol

Factors = tuple[Expr, ...]
"""A product of powers of coordinates, cosines, sines, base parameters and sums, in the order they are written."""
Terms = dict[Factors, fmpq]
"""A sum of products, each times a number that is not 0."""


@cache
def coordinate(joint: int) -> Symbol:
    """Return the position of a joint, counted from 0."""
    return Symbol(f"q{joint + 1}", real=True)


def parameter(name: str) -> Symbol:
    """Return a base parameter, or an inertial parameter of a body."""
    return Symbol(name, real=True)


def expression(terms: Terms) -> Expr:
    """Return the sum as it stands."""
    products = []
    for factors, value in terms.items():
        if value == 1 and factors:
            products.append(Mul(*factors, evaluate=False))
        else:
            products.append(Mul(Rational(int(value.p), int(value.q)), *factors, evaluate=False))
    return Add(*products, evaluate=False)


def length(terms: Terms) -> int:
    """Return how long a sum is to read: its terms and their factors, a bracket counting as one."""
    return len(terms) + sum(map(len, terms))


@lru_cache(4096)
def joints(factor: Expr) -> frozenset[int]:
    """Return the joints that a distance, a cosine or a sine depends on; none of a base parameter or a sum."""
    if factor.is_Add or (factor.is_Pow and factor.base.is_Add):
        return frozenset()
    names = [symbol.name for symbol in factor.free_symbols]
    return frozenset(int(name[1:]) - 1 for name in names if name.startswith("q"))


def ordered(factors: Iterable[Expr]) -> Factors:
    """Return the factors as they are written: distances and angles by joint, then sums."""
    return tuple(sorted(factors, key=lambda factor: min(joints(factor), default=inf)))


def times(terms: Terms, value: fmpq) -> Terms:
    """Return the sum with every term times ``value``."""
    return {factors: value * coefficient for factors, coefficient in terms.items()}


def bracketed(terms: Terms) -> tuple[fmpq, Terms]:
    """Return a number and a sum, of which ``terms`` is the product.

    A size stands before the brackets only where it leaves none inside, else no more than a sign.
    """
    if len(terms) < 2:
        return fmpq(1), terms
    # the sign of the first term goes outside, so that no bracket begins with a minus
    first, *following = terms.values()
    outside = fmpq(1)
    if all(abs(value) == abs(first) for value in following):
        outside = abs(first)
    if first < 0:
        outside = -outside
    return outside, times(terms, 1 / outside)


def collected(terms: Terms, inner: Set[int]) -> Terms:
    """Return the terms with the same factors of other joints as one: these factors times a sum over ``inner``."""
    groups: dict[Factors, Terms] = {}
    for factors, value in terms.items():
        inside = tuple(factor for factor in factors if joints(factor) <= inner)
        outside = tuple(factor for factor in factors if factor not in inside)
        groups.setdefault(outside, {})[inside] = value
    result: Terms = {}
    for outside, group in groups.items():
        if len(group) == 1 or not outside:
            for inside, value in group.items():
                result[ordered((*inside, *outside))] = value
        else:
            number, bracket = bracketed(group)
            result[*outside, expression(bracket)] = number
    return result


def grouped(functions: Sequence[tuple[Symbol, Terms]]) -> Expr:
    """Return the sum of parameters times functions; parameters with one function, up to a factor, together."""
    groups: dict[tuple[tuple[Factors, fmpq], ...], Terms] = {}
    for symbol, function in functions:
        leading = next(iter(function.values()))
        unit = tuple(times(function, 1 / leading).items())
        groups.setdefault(unit, {})[symbol,] = leading
    total: Terms = {}
    constant = (((), fmpq(1)),)
    for unit, members in sorted(groups.items(), key=lambda group: group[0] != constant):  # constants first
        number = fmpq(1)
        factors, _ = unit[0]
        if len(unit) > 1:
            first = abs(next(iter(members.values())))
            number, bracket = bracketed(times(dict(unit), first))
            factors = (expression(bracket),)
            members = times(members, 1 / first)
        if len(members) > 1 and factors:
            size, parameters = bracketed(members)
            total[expression(parameters), *factors] = number * size
            continue
        for symbol, value in members.items():
            total[*symbol, *factors] = number * value
    # a common factor before the sum: 2*(a + b) is shorter than 2*a + 2*b
    size = abs(bracketed(total)[0])
    if size == 1:
        return expression(total)
    return expression({(expression(times(total, 1 / size)),): size})
