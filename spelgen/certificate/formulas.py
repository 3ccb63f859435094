"""Closed forms of M(q) and V(q), linear in the base inertial parameters, as SymPy expressions.

Each entry is expanded exactly (``expansion``), its terms are collected per base parameter (``base_parameters``) and
expressed with sums of angles (``expressions``). For an entry that is too long, only the number of terms is given.
"""

from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Literal

from flint import fmpq_mpoly
from sympy import Expr, Integer, Matrix, Rational, Symbol

from spelgen.arm.arm import Chain
from spelgen.certificate.expressions import (
    PolynomialWriter,
    coordinate,
    grouped,
    latex,
    parameter,
    weighted_sum,
)
from spelgen.errors import SpelgenError
from spelgen.labels import entry_name, parameter_name
from spelgen.listing import Listing
from spelgen.structure.base_parameters import BaseParameter, base_parameters, rational
from spelgen.structure.expansion import Budget, Expansion, TooLarge
from spelgen.structure.recursion import triangle
from spelgen.structure.structure import Structure

WRITABLE = 3000
"""Largest number of terms of an entry in a file for programs, or of a single requested entry."""

Entry = tuple[int, int] | Literal["V"]
"""An entry of M, (row, column) from 1, or V."""


@dataclass(frozen=True)
class Formula:
    """An entry of the lower triangle of M, or V: its number of terms and its expression.

    terms: products of a base parameter and a monomial in cosines, sines and distances; None if the expansion exceeds
    its budget. expression: with sums of angles; None if it is too long.
    """

    entry: Entry
    terms: int | None
    expression: Expr | None

    @property
    def name(self) -> str:
        """``M21`` or ``V``."""
        return "V" if self.entry == "V" else entry_name(self.entry[0] - 1, self.entry[1] - 1)

    @property
    def omission(self) -> str:
        """The reason for an entry without expression."""
        if self.terms is None:
            return "too many terms to be expanded"
        return f"{self.terms} terms, not written out"


@dataclass(frozen=True, repr=False)
class Formulas:
    """Closed forms of ``arm`` in the base parameters ``base``; V up to a constant.

    With ``inertials``, terms that vanish for the values of the URDF are omitted.
    """

    arm: Chain
    assume: str
    base: tuple[BaseParameter, ...]
    rows: tuple[Formula, ...]

    @property
    def q(self) -> tuple[Symbol, ...]:
        """The positions of the joints [rad, m]."""
        return tuple(map(coordinate, range(len(self.arm.coordinates))))

    @cached_property
    def entries(self) -> dict[tuple[int, int], Expr]:
        """Expressions of the entries of M that are not too long: {(row, column): entry}, lower triangle, from 1."""
        return {row.entry: row.expression for row in self.written if row.entry != "V"}

    @property
    def mass_matrix(self) -> Matrix | None:
        """M(q); None if an entry has no expression."""
        n = len(self.arm.coordinates)
        if len(self.entries) < n * (n + 1) // 2:
            return None
        return Matrix(n, n, lambda i, j: self.entries[max(i, j) + 1, min(i, j) + 1])

    @property
    def potential(self) -> Expr | None:
        """V(q) [J]; None if it has no expression."""
        return next((row.expression for row in self.written if row.entry == "V"), None)

    @property
    def base_parameters(self) -> dict[Symbol, Expr]:
        """Return the definition of each base parameter as a sum of inertial parameters of the bodies.

        m is a mass [kg], h = m c a first moment [kg m] and I an inertia tensor [kg m2] about the origin of the joint's
        frame, whose z axis is the axis of the joint.
        """
        definitions = {}
        for base in self.base:
            terms = {parameter(parameter_name(index)): rational(weight) for index, weight in base.weights}
            definitions[parameter(base.name)] = weighted_sum(terms)
        return definitions

    @property
    def values(self) -> dict[Symbol, Rational]:
        """Exact values of the base parameters from the URDF, if it has inertials."""
        return {parameter(base.name): Rational(base.value) for base in self.base if base.value is not None}

    @property
    def trusted(self) -> str:
        """The inertial values for which the formulas are valid."""
        return (
            "the URDF's inertial zeros and symmetries"
            if self.assume == "inertials"
            else "any inertial values"
        )

    @property
    def written(self) -> tuple[Formula, ...]:
        """The entries with an expression."""
        return tuple(row for row in self.rows if row.expression is not None)

    @property
    def unwritten(self) -> tuple[Formula, ...]:
        """The entries without an expression."""
        return tuple(row for row in self.rows if row.expression is None)

    def __repr__(self) -> str:
        counts = f"{len(self.written)} written, in {len(self.base)} base parameters"
        return f"<Formulas of {self.arm.name!r}: {counts}>"

    def _repr_html_(self) -> str:
        """A table of LaTeX, for a notebook."""
        rows = []
        for row in self.rows:
            rows.append((row.name, row.omission if row.expression is None else f"${latex(row.expression)}$"))
        return Listing(f"{self.arm.name}: closed forms", ("", ""), tuple(rows), left=(0, 1)).html()


def formulas(
    arm: Chain, structure: Structure, *, entry: Entry | None = None, longest: int | None = None
) -> Formulas:
    """Return closed forms of all entries of M and of V, or of one ``entry``.

    Entries of more than ``longest`` terms (by default 40, for one entry ``WRITABLE``) have no expression.
    Raises SpelgenError for an entry that M does not have.
    """
    n = len(arm.coordinates)
    entries: list[Entry] = [*((row + 1, column + 1) for row, column in triangle(n)), "V"]
    if entry is not None:
        lower: Entry = entry if entry == "V" else (max(entry), min(entry))
        # M is symmetric: 1,2 is written as 2,1
        if lower not in entries:
            expected = f"a row and a column from 1 to {n}, or V"
            raise SpelgenError(f"the entry {entry[0]},{entry[1]} of M", expected=expected)
        entries = [lower]
    if longest is None:
        # 40 terms are three lines of a terminal
        longest = 40 if entry is None else WRITABLE
    writer = _Writer(arm, structure)
    budget = Budget(2_000_000)  # multiplications of terms, about 2 s
    # Entries close to the tip are short: they come first, before the budget is exhausted.
    rows = [writer.formula(x, longest, budget) for x in reversed(entries)]
    # For a single entry, list only its own parameters.
    base = writer.base
    if entry is not None:
        symbols = (rows[0].expression or Integer(0)).free_symbols
        base = tuple(x for x in base if parameter(x.name) in symbols)
    return Formulas(arm, structure.assume, base, tuple(reversed(rows)))


class _Writer:
    """The formulas of the entries of one arm; recursion and base parameters are computed once."""

    def __init__(self, arm: Chain, structure: Structure):
        self._at_urdf_values = structure.assume == "inertials"
        self.base = tuple(base for base in base_parameters(arm) if base.value or not self._at_urdf_values)
        self._expansion = Expansion(arm)
        self._writer = PolynomialWriter(arm, self._expansion.context)

    def formula(self, entry: Entry, longest: int, budget: Budget) -> Formula:
        """Return an entry; it has no expression if it has more than ``longest`` terms or exceeds ``budget``."""
        try:
            polynomials = self._polynomials(entry, budget)
        except TooLarge:
            return Formula(entry, None, None)
        # counted first: an entry that is too long is not converted to expressions
        terms = sum(map(len, polynomials.values()))
        if terms > longest:
            return Formula(entry, terms, None)
        present = {name: polynomial for name, polynomial in polynomials.items() if polynomial}
        functions = [
            (parameter(name), self._writer.terms(polynomial)) for name, polynomial in present.items()
        ]
        return Formula(entry, terms, grouped(functions))

    def _polynomials(self, entry: Entry, budget: Budget) -> dict[str, fmpq_mpoly]:
        """Return the polynomial coefficient of each base parameter, without the constant of V. Raises TooLarge."""
        energies = self._expansion.energies
        element = energies.potential if entry == "V" else energies.mass[entry[0] - 1, entry[1] - 1]
        polynomials = {}
        total = self._expansion.context.from_dict({})
        for base in self.base:
            # The coefficient of a base parameter is the coefficient of its first inertial parameter.
            polynomial = self._writer.reduced(self._expansion.polynomial(element, base.index, budget))
            # V has an arbitrary constant: without it the formula is shorter
            if entry == "V":
                polynomial -= polynomial[(0,) * self._expansion.context.nvars()]
            polynomials[base.name] = polynomial
            total += rational(base.value or Fraction(0)) * polynomial
        if not self._at_urdf_values:
            return polynomials
        # For the values of the URDF, a monomial may cancel between parameters.
        remaining = set(total.monoms())
        for name, polynomial in polynomials.items():
            terms = {monomial: value for monomial, value in polynomial.terms() if monomial in remaining}
            polynomials[name] = self._expansion.context.from_dict(terms)
        return polynomials
