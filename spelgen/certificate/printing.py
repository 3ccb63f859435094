"""Print expressions with SymPy's own printers: text and LaTeX with decimals, Python with exact fractions.

Blanks that must not end a line are no-break spaces until the lines are made.
"""

from __future__ import annotations

import re
import textwrap

from sympy import Add, Expr, Float, Rational
from sympy.core.parameters import distribute
from sympy.printing.latex import LatexPrinter
from sympy.printing.str import StrPrinter

# textwrap breaks lines at blanks alone, so a no-break space holds a line together
_FIXED = "\N{NO-BREAK SPACE}"
_LONG_SUM = 20
_DIGITS = 12
_DOUBLE = 10**17  # more digits than a double holds


def text(expression: Expr) -> str:
    """Return it as one types it: numbers as decimals of up to twelve digits."""
    result: str = StrPrinter({"full_prec": False}).doprint(_rounded(expression, 1, _DIGITS))
    return result


def latex(expression: Expr) -> str:
    r"""Return a formula of LaTeX's, with brackets that unlike \left( may stand on different lines."""
    names = {symbol: _latex_name(symbol.name) for symbol in expression.free_symbols}
    printer = LatexPrinter({"full_prec": False, "mul_symbol": r" \, ", "symbol_names": names})
    formula: str = printer.doprint(_rounded(expression, 1, _DIGITS))
    return formula.replace(r"\left(", r"\bigl(").replace(r"\right)", r"\bigr)")


def python(expression: Expr) -> str:
    """Return Python that SymPy evaluates exactly, but for fractions of more digits than a double has."""
    result: str = _PythonPrinter({"sympy_integers": True}).doprint(_rounded(expression, _DOUBLE, 17))
    return result


def lines(formula: str, start: str, width: int, end: str = "") -> list[str]:
    """Return a formula between ``start`` and ``end``, broken where lines get longer than ``width``."""
    indent = " " * (len(start) - len(start.lstrip()) + 4)
    # a sign stays with what follows it; angles, and short brackets, stay in one line
    formula = re.sub(r"([+-]) ", rf"\1{_FIXED}", formula)
    brackets = re.findall(r"\((?:[^()]|\([^()]*\))+\)", formula)
    angles = re.findall(r"(?:cos|sin)\b.*?\)", formula)
    for text in dict.fromkeys([*brackets, *angles, r" \, "]):
        if len(text) < width // 2 or text in angles:
            formula = formula.replace(text, text.replace(" ", _FIXED))
    wrapped = textwrap.fill(
        start + formula + end, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )
    return wrapped.replace(_FIXED, " ").split("\n")


class _PythonPrinter(StrPrinter):  # type: ignore[misc]  # SymPy has no types
    def _print_Add(self, expression: Add, order: str | None = None) -> str:
        """Print a long sum in one call, since Python cannot nest thousands of additions."""
        if len(expression.args) <= _LONG_SUM:
            result: str = super()._print_Add(expression, order)
            return result
        return f"Add({', '.join(map(self._print, expression.args))})"


def _rounded(expression: Expr, largest: int, digits: int) -> Expr:
    """Return it with decimals for fractions whose numerator or denominator exceeds ``largest``."""
    decimals = {}
    for number in expression.atoms(Rational):
        if not number.is_Integer and max(abs(number.p), number.q) > largest:
            decimals[number] = Float(number, digits)
    # SymPy would else multiply brackets out
    with distribute(False):
        return expression.xreplace(decimals)


def _latex_name(name: str) -> str:
    """Return ``Izz1R`` as I with the index zz,1R."""
    letter, axes, place = re.findall(r"(.)([a-z]*)(.*)", name)[0]
    index = ",".join(filter(None, [axes, place]))
    return f"{letter}_{{{index}}}" if index else str(letter)
