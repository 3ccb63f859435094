"""Closed forms of M(q) and V(q), linear in the base inertial parameters, as SymPy expressions.

Each entry is expanded exactly (``expansion``), its terms are collected by base parameter (``base_parameters``) and
written the shortest of several ways (``shortening``). What is too long is counted, not written.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Literal

from flint import fmpq, fmpq_mpoly, fmpq_mpoly_ctx
from sympy import Expr, Matrix, Rational, Symbol

from spelgen.arm.arm import Arm
from spelgen.certificate.printing import Latex
from spelgen.certificate.shortening import Shortener
from spelgen.certificate.terms import coordinate, expression, grouped, parameter
from spelgen.errors import SpelgenError
from spelgen.labels import entry_name
from spelgen.listing import Listing
from spelgen.structure.base_parameters import BaseParameter, base_parameters, parameter_name
from spelgen.structure.expansion import Budget, Expansion, TooLarge
from spelgen.structure.recursion import triangle
from spelgen.structure.structure import Structure

READABLE = 40
"""Terms of an entry that a person reads among others."""
WRITABLE = 3000
"""Terms of an entry that a program reads, or a person who asks for it alone."""
_BUDGET = 300_000  # multiplications of terms for an entry, about 0.3 s
_WHOLE_BUDGET = 2_000_000

Place = tuple[int, int] | None
"""An entry of M, 0-based with row >= column; None stands for V."""
Entry = tuple[int, int] | Literal["V"]
"""An entry as users name it: (row, column) from 1, or V."""
_Polynomials = list[tuple[BaseParameter, fmpq_mpoly]]


@dataclass(frozen=True)
class Formula:
    """One entry of M, or V: its number of terms, and how it is written.

    ``terms`` counts products of a base parameter and a monomial in cosines, sines and distances, before
    they are shortened; None where they were too many to be expanded. ``expression`` is None where it is too
    long.
    """

    place: Place
    terms: int | None
    expression: Expr | None

    @property
    def name(self) -> str:
        """``M21`` or ``V``."""
        return "V" if self.place is None else entry_name(*self.place)

    @property
    def omission(self) -> str:
        """Why it is not written out."""
        return f"{self.terms} terms, not written out" if self.terms else "too many terms to be expanded"


@dataclass(frozen=True, repr=False)
class Formulas:
    """Closed forms of ``arm`` in the base parameters ``base``; V up to a constant.

    Sums and products stand as they were chosen: SymPy did not evaluate them, and what it makes of them (a
    derivative, a substitution) it does. Under ``inertials`` terms that vanish for the URDF's values are left out.
    """

    arm: Arm
    assume: str
    base: tuple[BaseParameter, ...]
    rows: tuple[Formula, ...]

    @property
    def q(self) -> tuple[Symbol, ...]:
        """The joints' positions [rad, m]."""
        return tuple(coordinate(joint) for joint in range(len(self.arm.coordinates)))

    @cached_property
    def entries(self) -> dict[tuple[int, int], Expr]:
        """(row, column) -> entry of M that is not too long; the lower triangle, counted from 1."""
        return {
            (each.place[0] + 1, each.place[1] + 1): each.expression
            for each in self.rows
            if each.place and each.expression is not None
        }

    @property
    def mass_matrix(self) -> Matrix | None:
        """M(q), None where entries are missing."""
        n = len(self.arm.coordinates)
        if len(self.entries) < n * (n + 1) // 2:
            return None
        return Matrix(n, n, lambda i, j: self.entries[max(i, j) + 1, min(i, j) + 1])

    @property
    def potential(self) -> Expr | None:
        """V(q) [J], None where it is missing."""
        return next((each.expression for each in self.rows if each.place is None), None)

    @property
    def base_parameters(self) -> dict[Symbol, Expr]:
        """What each parameter in the expressions is the sum of, by body: m a mass [kg], h = m c a first moment
        [kg m] and I a tensor [kg m2] about the joint's origin, in a frame whose z is the joint's axis.
        """
        return {
            parameter(each.name): expression(
                {(parameter(parameter_name(index)),): _rational(share) for index, share in each.weights}
            )
            for each in self.base
        }

    @property
    def values(self) -> dict[Symbol, Rational]:
        """The base parameters' exact values by the URDF, where it has inertials."""
        return {parameter(each.name): Rational(each.value) for each in self.base if each.value is not None}

    @property
    def trusted(self) -> str:
        """For which inertial values the formulas hold."""
        own = self.assume == "inertials"
        return "the URDF's inertial zeros and symmetries" if own else "any inertial values"

    @property
    def unwritten(self) -> tuple[Formula, ...]:
        """The entries that were too long."""
        return tuple(each for each in self.rows if each.expression is None)

    def __repr__(self) -> str:
        written = sum(each.expression is not None for each in self.rows)
        return f"<Formulas of {self.arm.name!r}: {written} written, in {len(self.base)} base parameters>"

    def _repr_html_(self) -> str:
        """A table of LaTeX, for a notebook."""
        rows = [
            (each.name, each.omission if each.expression is None else f"${Latex().whole(each.expression)}$")
            for each in self.rows
        ]
        return Listing(f"{self.arm.name}: closed forms", ("", ""), tuple(rows), left=(0, 1)).html()


def formulas(
    arm: Arm, structure: Structure, *, entry: Entry | None = None, longest: int | None = None
) -> Formulas:
    """Closed forms of all entries of M and of V, or of one ``entry``.

    Entries of more than ``longest`` terms (``READABLE``, of one entry ``WRITABLE``) are counted and not
    written. Raises SpelgenError for an entry that M does not have.
    """
    n = len(arm.coordinates)
    order: list[Place] = [*triangle(n), None] if entry is None else [_place(n, entry)]
    if longest is None:
        longest = READABLE if entry is None else WRITABLE
    base = base_parameters(arm, structure.base_parameter_count)
    if structure.assume == "inertials":
        base = tuple(each for each in base if each.value)
    expansion = Expansion(arm)
    shortener = Shortener(arm, expansion.context)
    left, found = _WHOLE_BUDGET, dict[Place, Formula]()
    for place in reversed(order):  # from the tip on, so that what is cheap is not left out for what is dear
        budget = Budget(left if entry else min(left, _BUDGET))
        before = budget.left
        try:
            polynomials = _polynomials(expansion, shortener, base, place, budget)
        except TooLarge:
            found[place] = Formula(place, None, None)
        else:
            if structure.assume == "inertials":
                polynomials = _at_urdf_values(expansion.context, polynomials)
            found[place] = _formula(shortener, place, polynomials, longest)
        left -= before - budget.left
    rows = tuple(found[place] for place in order)
    if entry:
        told = {
            symbol.name
            for each in rows
            if each.expression is not None
            for symbol in each.expression.free_symbols
        }
        base = tuple(each for each in base if each.name in told)
    return Formulas(arm, structure.assume, base, rows)


def _place(n: int, entry: Entry) -> Place:
    if entry == "V":
        return None
    row, column = max(entry), min(entry)
    if column < 1 or row > n:
        raise SpelgenError(
            f"the entry {entry[0]},{entry[1]} of M", expected=f"a row and a column from 1 to {n}, or V"
        )
    return row - 1, column - 1


def _polynomials(
    expansion: Expansion, shortener: Shortener, base: Sequence[BaseParameter], place: Place, budget: Budget
) -> _Polynomials:
    """What each base parameter is multiplied by, without the constant part of V. Raises TooLarge."""
    element = expansion.written.potential if place is None else expansion.written.mass[place]
    found = []
    for each in base:
        # the parameters regrouped into this one have their part in its first one's polynomial
        polynomial = shortener.reduced(expansion.polynomial(element, each.index, budget))
        constant = polynomial[(0,) * len(expansion.context.gens())]
        found.append((each, polynomial if place else polynomial - constant))
    return found


def _at_urdf_values(context: fmpq_mpoly_ctx, polynomials: _Polynomials) -> _Polynomials:
    """Without the monomials whose coefficient is zero for the URDF's values."""
    scaled = (_rational(each.value or Fraction(0)) * polynomial for each, polynomial in polynomials)
    total = sum(scaled, context.from_dict({}))
    kept = []
    for each, polynomial in polynomials:
        left = {monomial: share for monomial, share in polynomial.terms() if total[monomial] != 0}
        kept.append((each, context.from_dict(left)))
    return kept


def _formula(shortener: Shortener, place: Place, polynomials: _Polynomials, longest: int) -> Formula:
    terms = sum(len(polynomial) for _, polynomial in polynomials)
    if terms > longest:
        return Formula(place, terms, None)
    functions = [
        (parameter(x.name), shortener.shortest(function)) for x, function in polynomials if function != 0
    ]
    return Formula(place, terms, grouped(functions))


def _rational(number: Fraction) -> fmpq:
    return fmpq(number.numerator, number.denominator)
