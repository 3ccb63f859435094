"""Ways of writing an expression: as one types it, for LaTeX, and for SymPy.

Nothing is evaluated or rearranged here: what ``shortening`` chose is what is printed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from fractions import Fraction

from spelgen.formulas.expression import Angle, Factor, Sum, Symbol, Term, Trig

_LONG_SUM = 20


class Notation(ABC):
    """A way of writing expressions."""

    product = "*"

    def sum(self, expression: Sum) -> list[str]:
        """The terms, each with its sign, the first without a plus."""
        parts: list[str] = []
        for term in expression.terms:
            sign = "-" if term.coefficient < 0 else "+"
            body = self.term(Term(abs(term.coefficient), term.factors))
            parts.append(f"{sign} {body}" if parts else body if sign == "+" else f"-{body}")
        return parts or ["0"]

    def term(self, term: Term) -> str:
        """A term with a positive coefficient."""
        written = [self._power(factor, power) for factor, power in term.factors]
        if term.coefficient != 1 or not written:
            written.insert(0, self.number(term.coefficient))
        return self.product.join(written)

    def _power(self, factor: Factor, power: int) -> str:
        if isinstance(factor, Sum):
            body = self.bracketed(factor)
        elif isinstance(factor, Trig):
            return self.trig(factor, power)
        else:
            body = self.symbol(factor.name) if isinstance(factor, Symbol) else self.coordinate(factor.joint)
        return body if power == 1 else self.raised(body, power)

    def angle(self, angle: Angle) -> str:
        """A sum of multiples of coordinates."""
        parts: list[str] = []
        for joint, multiple in angle:
            sign = "-" if multiple < 0 else "+"
            size = "" if abs(multiple) == 1 else f"{self.number(abs(multiple))}{self.product}"
            body = f"{size}{self.coordinate(joint)}"
            parts.append(f"{sign} {body}" if parts else body if sign == "+" else f"-{body}")
        return " ".join(parts)

    def trig(self, factor: Trig, power: int) -> str:
        """A power of a cosine or sine."""
        body = f"{factor.function}({self.angle(factor.angle)})"
        return body if power == 1 else self.raised(body, power)

    def bracketed(self, expression: Sum) -> str:
        """A sum that is a factor."""
        return f"({' '.join(self.sum(expression))})"

    def raised(self, text: str, power: int) -> str:
        """The text to a power."""
        return f"{text}**{power}"

    def symbol(self, name: str) -> str:
        """A base parameter, or an inertial parameter of a body."""
        return name

    def coordinate(self, joint: int) -> str:
        """A joint's position."""
        return f"q{joint + 1}"

    @abstractmethod
    def number(self, value: Fraction) -> str:
        """A positive number."""


class Plain(Notation):
    """As one types it: numbers as short decimals, else with twelve digits."""

    def number(self, value: Fraction) -> str:
        """A positive number."""
        return decimal(value)


class Latex(Notation):
    """For a formula of LaTeX's."""

    product = r" \, "

    def number(self, value: Fraction) -> str:
        """A positive number."""
        mantissa, _, exponent = decimal(value).partition("e")
        if "/" in mantissa:
            return r"\tfrac{{{}}}{{{}}}".format(*mantissa.split("/"))
        return rf"{mantissa} \cdot 10^{{{int(exponent)}}}" if exponent else mantissa

    def trig(self, factor: Trig, power: int) -> str:
        """A power of a cosine or sine."""
        single = len(factor.angle) == 1 and factor.angle[0][1] == 1
        angle = self.angle(factor.angle)
        raised = "" if power == 1 else f"^{{{power}}}"
        return rf"\{factor.function}{raised} {angle}" if single else rf"\{factor.function}{raised}({angle})"

    def bracketed(self, expression: Sum) -> str:
        """A sum that is a factor."""
        # unlike \left( these may stand on different lines
        return rf"\bigl({' '.join(self.sum(expression))}\bigr)"

    def raised(self, text: str, power: int) -> str:
        """The text to a power."""
        return f"{text}^{{{power}}}"

    def symbol(self, name: str) -> str:
        """A base parameter: ``Izz1R`` as I with the index zz,1R."""
        letter, index = name[0], name[1:]
        axes = index.rstrip("0123456789R")
        place = index[len(axes) :]
        return f"{letter}_{{{axes},{place}}}" if axes else f"{letter}_{{{place}}}"

    def coordinate(self, joint: int) -> str:
        """A joint's position."""
        return f"q_{{{joint + 1}}}"


class Sympy(Notation):
    """Python that SymPy evaluates exactly."""

    def bracketed(self, expression: Sum) -> str:
        """A sum that is a factor; a long one in one call, since Python cannot nest thousands of additions."""
        if len(expression.terms) <= _LONG_SUM:
            return super().bracketed(expression)
        alone = (" ".join(self.sum(Sum((term,)))) for term in expression.terms)
        return f"Add({', '.join(alone)})"

    def number(self, value: Fraction) -> str:
        """A positive number: a fraction as it is, unless it has more digits than a double."""
        if value.denominator == 1:
            return str(value.numerator)
        if max(value.numerator, value.denominator) < 10**17:
            return f"Rational({value.numerator}, {value.denominator})"
        return f"Float({float(value)!r})"


def decimal(value: Fraction) -> str:
    """A positive number: an exact decimal or a small fraction where it is one, else twelve digits."""
    short = f"{float(value):.12g}"
    if Fraction(short) == value or value.denominator > 16:
        return short
    return f"{value.numerator}/{value.denominator}"
