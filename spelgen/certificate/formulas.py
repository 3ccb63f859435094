"""Closed forms of M(q) and the potential energy V(q), linear in the base inertial parameters, as SymPy expressions.

Each entry of M, and V, is expanded exactly to polynomials (``structure.expansion``). Its terms are collected per base
parameter (``structure.base_parameters``) and expressed with cosines and sines of sums of angles (``expressions``). For
an entry that is too long, only the number of terms is given.
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
    parameter,
    text,
    weighted_sum,
)
from spelgen.errors import SpelgenError
from spelgen.labels import entry_name, parameter_name
from spelgen.listing import Listing
from spelgen.structure.base_parameters import BaseParameter, base_parameters, rational
from spelgen.structure.expansion import Expansion, TooLarge
from spelgen.structure.recursion import triangle
from spelgen.structure.structure import Structure

WRITABLE = 3000
"""Largest number of terms of an entry of M, or of V, that is written to a file or requested as a single entry."""

Entry = tuple[int, int] | Literal["V"]
"""An entry of M as (row, column), counted from 1, or the potential energy V."""


@dataclass(frozen=True)
class Formula:
    """Closed form of an entry of the lower triangle of M, or of the potential energy V.

    Attributes:
        entry: (row, column) counted from 1, or "V".
        terms: number of products of a base parameter and a monomial in cosines, sines and positions of prismatic
            joints; None if the expansion would exceed the permitted number of multiplications (`Expansion.budget`).
        expression: SymPy expression; None if the entry is too long.
    """

    entry: Entry
    terms: int | None
    expression: Expr | None

    @property
    def name(self) -> str:
        """Name of the entry of M, such as ``M21``, or ``V`` for the potential energy."""
        return "V" if self.entry == "V" else entry_name(self.entry[0] - 1, self.entry[1] - 1)

    @property
    def omission(self) -> str:
        """Text for users: reason why the entry has no expression."""
        if self.terms is None:
            return "too many terms to be expanded"
        return f"{self.terms} terms, omitted"


@dataclass(frozen=True, repr=False)
class Formulas:
    """Closed forms of M, and of the potential energy V up to a constant, in the base parameters of an arm.

    Attributes:
        arm: the arm.
        assume: ``inertials``: terms that are zero for the inertials of the URDF are omitted. ``kinematics``: all terms.
        base: base parameters in the closed forms.
        rows: one closed form per entry of the lower triangle of M, then V.
    """

    arm: Chain
    assume: str
    base: tuple[BaseParameter, ...]
    rows: tuple[Formula, ...]

    @property
    def q(self) -> tuple[Symbol, ...]:
        """Symbols of the positions of the joints [rad, m]."""
        return tuple(map(coordinate, range(len(self.arm.coordinates))))

    @cached_property
    def entries(self) -> dict[tuple[int, int], Expr]:
        """{(row, column): expression} of the entries in the lower triangle of M that have an expression.

        Rows and columns are counted from 1.
        """
        return {row.entry: row.expression for row in self.written if row.entry != "V"}

    @property
    def mass_matrix(self) -> Matrix | None:
        """M(q) as a SymPy matrix (n, n); None if an entry has no expression."""
        n = len(self.arm.coordinates)
        if len(self.entries) < n * (n + 1) // 2:
            return None
        return Matrix(n, n, lambda i, j: self.entries[max(i, j) + 1, min(i, j) + 1])

    @property
    def potential(self) -> Expr | None:
        """Expression of the potential energy V(q) [J]; None if V has no expression."""
        return next((row.expression for row in self.written if row.entry == "V"), None)

    @property
    def base_parameters(self) -> dict[Symbol, Expr]:
        """{symbol of a base parameter: its definition as a linear combination of inertial parameters of bodies}.

        In the names of inertial parameters, m is a mass [kg], h = m c a first moment [kg m] with the centre of mass c,
        and I an inertia tensor [kg m^2] about the origin of the joint frame, whose z axis is the axis of the joint.
        """
        definitions = {}
        for base in self.base:
            terms = {parameter(parameter_name(index)): rational(weight) for index, weight in base.weights}
            definitions[parameter(base.name)] = weighted_sum(terms)
        return definitions

    @property
    def values(self) -> dict[Symbol, Rational]:
        """{symbol of a base parameter: exact value for the inertials of the URDF}; empty if the URDF has none."""
        return {parameter(base.name): Rational(base.value) for base in self.base if base.value is not None}

    @property
    def trusted(self) -> str:
        """Text that states for which inertial parameters the formulas are valid.

        The formulas are valid for parameters of any values or, with ``assume="inertials"``, for parameters with the
        zeros and symmetries of the URDF's parameters.
        """
        if self.assume == "inertials":
            return "the URDF's inertial zeros and symmetries"
        return "any inertial values"

    @property
    def written(self) -> tuple[Formula, ...]:
        """The formulas of entries of M and of V that have an expression: all except for those with too many terms."""
        return tuple(row for row in self.rows if row.expression is not None)

    @property
    def unwritten(self) -> tuple[Formula, ...]:
        """The formulas without an expression: closed forms of entries of M, or of V, that have too many terms."""
        return tuple(row for row in self.rows if row.expression is None)

    def __repr__(self) -> str:
        counts = f"{len(self.written)} written, in {len(self.base)} base parameters"
        return f"<Formulas of {self.arm.name!r}: {counts}>"

    def _repr_html_(self) -> str:
        """Return a table of the closed forms, for a notebook."""
        rows = []
        for row in self.rows:
            rows.append((row.name, row.omission if row.expression is None else text(row.expression)))
        return Listing(f"{self.arm.name}: closed forms", ("", ""), rows, left=(0, 1)).html()


def formulas(
    arm: Chain, structure: Structure, *, entry: Entry | None = None, longest: int | None = None
) -> Formulas:
    """Return closed forms of all entries of M and of the potential energy V, or only of one entry.

    Args:
        arm: The arm.
        structure: Structure of the arm.
        entry: (row, column) of an entry of M, counted from 1, or "V"; None: all entries and V.
        longest: Largest number of terms of an entry; longer entries have no expression. Default: 40, or 3,000
            (``WRITABLE``) for one entry.

    Raises SpelgenError for an entry that M does not have.
    """
    n = len(arm.coordinates)
    entries: list[Entry] = [*((row + 1, column + 1) for row, column in triangle(n)), "V"]
    if entry is not None:
        lower = entry if entry == "V" else (max(entry), min(entry))
        # M is symmetric, and only its lower triangle is computed: entry (2, 1) is returned for (1, 2).
        if lower not in entries:
            expected = f"a row and a column from 1 to {n}, or V"
            raise SpelgenError(f"the entry {entry[0]},{entry[1]} of M", expected=expected)
        entries = [lower]
    if longest is None:
        # By default, only entries of at most 40 terms are shown: longer formulas, above three lines, are hard to read.
        longest = 40 if entry is None else WRITABLE
    writer = _Writer(arm, structure)
    # Entries of joints close to the tip are short. They are expanded first, so that they have expressions even if the
    # budget of the expansion does not suffice for all entries.
    rows = [writer.formula(x, longest) for x in reversed(entries)]
    # For a single entry, only the base parameters in its expression are listed.
    base = writer.base
    if entry is not None:
        symbols = (rows[0].expression or Integer(0)).free_symbols
        base = tuple(x for x in base if parameter(x.name) in symbols)
    return Formulas(arm, structure.assume, base, tuple(reversed(rows)))


class _Writer:
    """Computes closed forms of entries of M and of the potential energy V.

    One `Expansion`, which expands M and V to polynomials, is used for all entries.

    Attributes:
        base: base parameters in the closed forms.
    """

    def __init__(self, arm: Chain, structure: Structure):
        self._at_urdf_values = structure.assume == "inertials"
        self.base = tuple(base for base in base_parameters(arm) if base.value or not self._at_urdf_values)
        self._expansion = Expansion(arm)
        self._writer = PolynomialWriter(arm, self._expansion.context)

    def formula(self, entry: Entry, longest: int) -> Formula:
        """Return the closed form of an entry of M, or of the potential energy V.

        It has no expression if it has more than ``longest`` terms, or if its expansion to polynomials would exceed the
        permitted number of multiplications (`Expansion.budget`).
        """
        try:
            polynomials = self._polynomials(entry)
        except TooLarge:
            return Formula(entry, None, None)
        # Terms are counted before the conversion to SymPy, which would be slow for an entry that is too long.
        terms = sum(map(len, polynomials.values()))
        if terms > longest:
            return Formula(entry, terms, None)
        functions = []
        for name, polynomial in polynomials.items():
            if polynomial:
                functions.append((parameter(name), self._writer.terms(polynomial)))
        return Formula(entry, terms, grouped(functions))

    def _polynomials(self, entry: Entry) -> dict[str, fmpq_mpoly]:
        """Return {base parameter: coefficient of this parameter in an entry of M, or in V without its constant}.

        A coefficient is a polynomial in sines, cosines and positions of the joints. Raises TooLarge if the expansion
        would exceed the permitted number of multiplications (`Expansion.budget`).
        """
        energies = self._expansion.energies
        element = energies.potential if entry == "V" else energies.mass[entry[0] - 1, entry[1] - 1]
        polynomials = {}
        total = self._expansion.context.from_dict({})
        for base in self.base:
            # The first inertial parameter in the definition of a base parameter (with the index `base.index`) occurs in
            # no other base parameter. In M or V, the base parameter therefore has the same coefficient as this inertial
            # parameter.
            polynomial = self._writer.reduced(self._expansion.polynomial(element, base.index))
            # V is determined up to a constant: constant terms are omitted.
            if entry == "V":
                polynomial -= polynomial[(0,) * self._expansion.context.nvars()]
            polynomials[base.name] = polynomial
            total += rational(base.value or Fraction(0)) * polynomial
        if not self._at_urdf_values:
            return polynomials
        # These formulas need to be valid only for the inertials of the URDF. The same monomial may occur with several
        # base parameters. If its terms (coefficient times the URDF value of the base parameter) add up to zero, the
        # monomial does not affect M or V and is removed.
        remaining = set(total.monoms())
        for name, polynomial in polynomials.items():
            terms = {monomial: value for monomial, value in polynomial.terms() if monomial in remaining}
            polynomials[name] = self._expansion.context.from_dict(terms)
        return polynomials
