"""Closed forms of M(q) and V(q), linear in the base inertial parameters.

Each entry is expanded exactly (``expansion``), its terms are collected by base parameter (``base_parameters``) and
written the shortest of several ways (``shortening``). What is too long is counted, not written.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Literal

from flint import fmpq, fmpq_mpoly_ctx

from spelgen.arm.arm import Arm
from spelgen.errors import SpelgenError
from spelgen.formulas.expression import Sum, Symbol
from spelgen.formulas.grouping import Collected, grouped
from spelgen.formulas.notation import Plain
from spelgen.formulas.shortening import Shortener
from spelgen.labels import entry_name
from spelgen.listing import Listing
from spelgen.structure.base_parameters import BaseParameter, base_parameters
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


@dataclass(frozen=True)
class Formula:
    """One entry of M, or V: its number of terms, and how it is written.

    ``terms`` counts products of a base parameter and a monomial in cosines, sines and distances, before
    they are shortened; None where they were too many to be expanded. ``expression`` is None where it is too
    long.
    """

    place: Place
    terms: int | None
    expression: Sum | None

    @property
    def name(self) -> str:
        """``M21`` or ``V``."""
        return "V" if self.place is None else entry_name(*self.place)


@dataclass(frozen=True, repr=False)
class Formulas:
    """Closed forms of ``arm``, V up to a constant, in the parameters ``base``.

    Under ``inertials`` terms that vanish for the URDF's values are left out.
    """

    arm: Arm
    assume: str
    base: tuple[BaseParameter, ...]
    entries: tuple[Formula, ...]

    def __repr__(self) -> str:
        written = len(self.entries) - len(self.unwritten)
        return f"<Formulas of {self.arm.name!r}: {written} written, in {len(self.base)} base parameters>"

    def _repr_html_(self) -> str:
        rows = [
            (each.name, "too long" if each.expression is None else " ".join(Plain().sum(each.expression)))
            for each in self.entries
        ]
        return Listing(f"{self.arm.name}: closed forms", ("", ""), tuple(rows), left=(0, 1)).html()

    @property
    def unwritten(self) -> tuple[Formula, ...]:
        """The entries that were too long."""
        return tuple(formula for formula in self.entries if formula.expression is None)


def formulas(
    arm: Arm, structure: Structure, *, entry: Entry | None = None, longest: int | None = None
) -> Formulas:
    """Closed forms of all entries of M and of V, or of one ``entry``.

    Entries of more than ``longest`` terms (``READABLE``, of one entry ``WRITABLE``) are counted and not
    written. Raises SpelgenError for an entry that M does not have.
    """
    if longest is None:
        longest = READABLE if entry is None else WRITABLE
    n = len(arm.coordinates)
    # from the tip on, so that what is cheap is not left out for what is dear
    wanted: list[Place] = [None, *reversed(triangle(n))] if entry is None else [_place(n, entry)]
    base = base_parameters(arm, structure.base_parameter_count)
    work = _Work(Expansion(arm), base, structure.assume, longest)
    shortener = Shortener(arm, work.expansion.context)
    left, found = _WHOLE_BUDGET, {}
    for place in wanted:
        budget = Budget(left if entry else min(left, _BUDGET))
        before = budget.left
        found[place] = _formula(work, shortener, place, budget)
        left -= before - budget.left
    order: list[Place] = [*triangle(n), None]
    entries = tuple(found[place] for place in order if place in found)
    return Formulas(arm, structure.assume, _used(work, entries, entry is None), entries)


@dataclass(frozen=True)
class _Work:
    """What every entry is made from."""

    expansion: Expansion
    base: tuple[BaseParameter, ...]
    assume: str
    longest: int


def _place(n: int, entry: Entry) -> Place:
    if entry == "V":
        return None
    row, column = max(entry), min(entry)
    if column < 1 or row > n:
        raise SpelgenError(
            f"the entry {entry[0]},{entry[1]} of M", expected=f"a row and a column from 1 to {n}, or V"
        )
    return row - 1, column - 1


def _formula(work: _Work, shortener: Shortener, place: Place, budget: Budget) -> Formula:
    expansion = work.expansion
    element = expansion.written.potential if place is None else expansion.written.mass[place]
    collected: Collected = []
    try:
        for parameter in work.base:
            # the parameters regrouped into this one have their part in its first one's polynomial
            polynomial = shortener.reduced(expansion.polynomial(element, parameter.index, budget))
            if place is None:
                polynomial -= polynomial[(0,) * len(expansion.context.gens())]
            collected.append((parameter, polynomial))
    except TooLarge:
        return Formula(place, None, None)
    if work.assume == "inertials":
        collected = _at_urdf_values(expansion.context, collected)
    collected = [(parameter, polynomial) for parameter, polynomial in collected if polynomial != 0]
    terms = sum(len(polynomial) for _, polynomial in collected)
    return Formula(place, terms, grouped(shortener, collected) if terms <= work.longest else None)


def _at_urdf_values(context: fmpq_mpoly_ctx, collected: Collected) -> Collected:
    """Without the monomials whose coefficient is zero for the URDF's values, and without zero parameters."""
    total = context.from_dict({})
    for parameter, polynomial in collected:
        total += _rational(parameter.value or Fraction(0)) * polynomial
    kept = []
    for parameter, polynomial in collected:
        if parameter.value:
            left = {monomial: share for monomial, share in polynomial.terms() if total[monomial] != 0}
            kept.append((parameter, context.from_dict(left)))
    return kept


def _used(work: _Work, entries: Sequence[Formula], everything: bool) -> tuple[BaseParameter, ...]:
    """All base parameters or, of one entry, those in it; under ``inertials`` without those that are 0."""
    if everything:
        return tuple(each for each in work.base if work.assume == "kinematics" or each.value)
    names = {name for formula in entries if formula.expression for name in _symbols(formula.expression)}
    return tuple(each for each in work.base if each.name in names)


def _symbols(expression: Sum) -> set[str]:
    found: set[str] = set()
    for term in expression.terms:
        for factor, _ in term.factors:
            if isinstance(factor, Symbol):
                found.add(factor.name)
            elif isinstance(factor, Sum):
                found |= _symbols(factor)
    return found


def _rational(number: Fraction) -> fmpq:
    return fmpq(number.numerator, number.denominator)
