"""Keep SymPy's printers from rearranging what was chosen, and lines of one width.

Blanks that must not end a line are no-break spaces until the lines are made.
"""

from __future__ import annotations

import re
import textwrap
from functools import cache

from sympy import Add, Expr, Function, Mul, Rational, Symbol
from sympy.printing.latex import LatexPrinter
from sympy.printing.precedence import PRECEDENCE
from sympy.printing.printer import Printer
from sympy.printing.str import StrPrinter

# textwrap breaks lines at blanks alone, so a no-break space holds a line together
_FIXED = "\N{NO-BREAK SPACE}"
_LONG_SUM = 20
_DOUBLE = 10**17  # more digits than a double holds


class _AsBuilt(Printer):  # type: ignore[misc]  # SymPy has no types
    """Print sums and products in the order they were put together, numbers as decimals."""

    times = "*"

    def whole(self, expression: Expr) -> str:
        """Return the expression in one line."""
        return str(self.doprint(expression)).replace(_FIXED, " ")

    def lines(self, expression: Expr, start: str, width: int, end: str = "") -> list[str]:
        """Return the expression between ``start`` and ``end``, broken where lines get longer than ``width``.

        Lines break before terms, and inside of those that are longer than a line.
        """
        indent = " " * (len(start) - len(start.lstrip()) + 4)
        pieces: list[str] = []
        for term in Add.make_args(expression):
            text = str(self.doprint(term))
            room = width - len(start)
            if pieces:
                text = self._signed(text)
                room = width - len(indent)
            if len(text) <= room:
                text = text.replace(" ", _FIXED)
            pieces.append(text)
        lines = textwrap.wrap(
            " ".join(pieces) + end, width, initial_indent=start, subsequent_indent=indent,
            break_long_words=False, break_on_hyphens=False,
        )  # fmt: skip
        return [line.replace(_FIXED, " ") for line in lines]

    def _signed(self, text: str) -> str:
        if text.startswith("-"):
            return f"-{_FIXED}{text[1:]}"
        return f"+{_FIXED}{text}"

    def _print_Add(self, expression: Add, order: str | None = None) -> str:
        first, *following = map(self._print, expression.args)
        return " ".join([first, *map(self._signed, following)])

    def _print_Mul(self, expression: Mul) -> str:
        number, factors = expression.as_coeff_mul()
        written = [self.parenthesize(factor, PRECEDENCE["Mul"]) for factor in factors]
        if abs(number) != 1:
            written.insert(0, self._print(abs(number)))
        return _sign(number) + self.times.join(written)

    def _print_Function(self, expression: Function, **power: str) -> str:
        text: str = super()._print_Function(expression, **power).replace(" ", _FIXED)
        return text

    def _print_Rational(self, number: Rational) -> str:
        return _sign(number) + decimal(abs(number))

    _print_Integer = _print_Rational


class Text(_AsBuilt, StrPrinter):  # type: ignore[misc]
    """Print as one types: numbers as short decimals, else with twelve digits."""


class Latex(_AsBuilt, LatexPrinter):  # type: ignore[misc]
    r"""Print a formula of LaTeX's, with brackets that unlike \left( may stand on different lines."""

    times = rf"{_FIXED}\,{_FIXED}"

    def _add_parens(self, text: str) -> str:
        return rf"\bigl({text}\bigr)"

    def _print_Symbol(self, symbol: Symbol, style: str = "plain") -> str:
        """Return ``Izz1R`` as I with the index zz,1R."""
        letter, axes, place = re.findall(r"(.)([a-z]*)(.*)", symbol.name)[0]
        if not place:
            return str(letter)
        if axes:
            return f"{letter}_{{{axes},{place}}}"
        return f"{letter}_{{{place}}}"

    def _print_Rational(self, number: Rational) -> str:
        mantissa, _, exponent = super()._print_Rational(number).partition("e")
        mantissa = re.sub(r"(\d+)/(\d+)", r"\\tfrac{\1}{\2}", mantissa)
        if exponent:
            return rf"{mantissa} \cdot 10^{{{int(exponent)}}}"
        return mantissa

    _print_Integer = _print_Rational


class Python(_AsBuilt, StrPrinter):  # type: ignore[misc]
    """Print Python that SymPy evaluates exactly: fractions as they are, unless they have more digits than a double."""

    def _print_Add(self, expression: Add, order: str | None = None) -> str:
        """Print a long sum in one call, since Python cannot nest thousands of additions."""
        if len(expression.args) <= _LONG_SUM:
            return super()._print_Add(expression)
        return f"Add({', '.join(map(self._print, expression.args))})"

    def _print_Rational(self, number: Rational) -> str:
        if number.q == 1:
            return str(number.p)
        if max(abs(number.p), number.q) < _DOUBLE:
            return f"Rational({number.p}, {number.q})"
        return f"Float({float(number)!r})"

    _print_Integer = _print_Rational


@cache
def decimal(value: Rational) -> str:
    """Return a positive number as an exact decimal or a small fraction where it is one, else with twelve digits."""
    short = f"{float(value):.12g}"
    if Rational(short) == value or value.q > 16:
        return short
    return f"{value.p}/{value.q}"


def _sign(number: Rational) -> str:
    if number < 0:
        return "-"
    return ""
