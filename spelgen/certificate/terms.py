"""Sums of products on their way to a short form: how long they are to read, and the SymPy expression they become.

SymPy evaluated would undo what is chosen here, as it makes 2*(a + b) into 2*a + 2*b; so nothing is evaluated.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence, Set
from functools import cache, lru_cache

from flint import fmpq
from sympy import Add, Expr, Mul, Rational, Symbol

Factors = tuple[Expr, ...]
"""A product of powers of coordinates, cosines, sines, base parameters and sums, in the order they are written."""
Terms = dict[Factors, fmpq]
"""A sum of products, each times a number that is not 0."""


@cache
def coordinate(joint: int) -> Symbol:
    """The position of a joint, counted from 0."""
    return Symbol(f"q{joint + 1}", real=True)


def parameter(name: str) -> Symbol:
    """A base parameter, or an inertial parameter of a body."""
    return Symbol(name, real=True)


def expression(terms: Terms) -> Expr:
    """The sum as it stands."""
    products = []
    for factors, value in terms.items():
        before = [] if value == 1 and factors else [Rational(int(value.p), int(value.q))]
        products.append(Mul(*before, *factors, evaluate=False))
    return Add(*products, evaluate=False)


def length(terms: Terms) -> float:
    """How long a sum is to read, about one for every symbol."""
    return sum(
        (0.3 if abs(value) == 1 and factors else 1.0) + sum(map(_length, factors))
        for factors, value in terms.items()
    )


@lru_cache(4096)
def _length(part: Expr) -> float:
    if part.is_Number or part.is_Symbol:
        return 0.7 if part.is_Number else 1.0
    if part.is_Pow:
        return 0.3 + _length(part.base)
    if part.is_Add:
        return 0.3 + sum(0.3 + _length(term) for term in part.args)
    if part.is_Mul:
        return sum(_length(factor) for factor in part.args if factor != -1)
    multiples = [
        term.as_coeff_Mul()[0] for term in Add.make_args(part.args[0])
    ]  # of a cosine's or sine's angle
    return 0.5 + sum(0.5 if abs(multiple) == 1 else 0.75 for multiple in multiples)


@lru_cache(4096)
def joints(factor: Expr) -> frozenset[int]:
    """The joints that a distance, a cosine or a sine depends on; none of a base parameter or a sum."""
    if factor.is_Add or (factor.is_Pow and factor.base.is_Add):
        return frozenset()
    return frozenset(int(each.name[1:]) - 1 for each in factor.free_symbols if each.name.startswith("q"))


def ordered(factors: Iterable[Expr]) -> Factors:
    """The factors as they are written: distances and angles by joint, then sums."""
    return tuple(sorted(factors, key=lambda factor: min(joints(factor), default=1_000)))


def times(terms: Terms, value: fmpq) -> Terms:
    """The sum with every term times ``value``."""
    return {factors: value * own for factors, own in terms.items()}


def bracketed(terms: Terms) -> tuple[fmpq, Terms]:
    """A number and a sum, of which ``terms`` is the product.

    A size stands before the brackets only where it leaves none inside, else no more than a sign.
    """
    if len(terms) < 2:
        return fmpq(1), terms
    sizes = {abs(value) for value in terms.values()}
    size = sizes.pop() if len(sizes) == 1 else fmpq(1)
    before = size if next(iter(terms.values())) > 0 else -size
    return before, times(terms, 1 / before)


def collected(terms: Terms, inner: Set[int]) -> Terms:
    """The terms with the same factors of other joints as one: these factors times a sum over ``inner``."""
    groups: dict[Factors, Terms] = {}
    for factors, value in terms.items():
        inside = tuple(each for each in factors if joints(each) <= inner)
        outside = tuple(each for each in factors if each not in inside)
        groups.setdefault(outside, {})[inside] = value
    found: Terms = {}
    for outside, group in groups.items():
        if len(group) == 1 or not outside:
            found |= {ordered((*inside, *outside)): value for inside, value in group.items()}
        else:
            before, within = bracketed(group)
            found[*outside, expression(within)] = before
    return found


def grouped(functions: Sequence[tuple[Symbol, Terms]]) -> Expr:
    """The sum of parameters times functions; parameters with the same function, up to a factor, together."""
    groups: dict[tuple[tuple[Factors, fmpq], ...], Terms] = {}
    for symbol, function in functions:
        leading = next(iter(function.values()))
        groups.setdefault(tuple(times(function, 1 / leading).items()), {})[symbol,] = leading
    whole: Terms = {}
    for unit, members in sorted(groups.items(), key=lambda group: group[0] != (((), 1),)):  # constants first
        whole |= _group(dict(unit), members)
    size = abs(bracketed(whole)[0])
    return expression(whole if size == 1 else {(expression(times(whole, 1 / size)),): size})


def _group(unit: Terms, members: Terms) -> Terms:
    """The terms of parameters times multiples of one function, given with 1 as its first coefficient."""
    before, factors = fmpq(1), next(iter(unit))
    if len(unit) > 1:
        first = abs(next(iter(members.values())))
        before, inside = bracketed(times(unit, first))
        factors, members = (expression(inside),), times(members, 1 / first)
    if len(members) > 1 and factors:
        size, together = bracketed(members)
        return {(expression(together), *factors): before * size}
    return {(*symbol, *factors): before * value for symbol, value in members.items()}
