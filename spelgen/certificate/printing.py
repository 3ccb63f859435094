"""Expressions as text, LaTeX and Python, by the printers of SymPy: with decimals, in Python with exact fractions.

Blanks at which a line must not be broken are no-break spaces until the text is wrapped.
"""

from __future__ import annotations

import re
import textwrap

from sympy import Add, Expr, Float, Rational
from sympy.core.parameters import distribute
from sympy.printing.latex import LatexPrinter
from sympy.printing.str import StrPrinter

from spelgen.certificate.tuning import TUNING

FLOAT_DIGITS = 17  # decimals that determine a double
_FIXED = "\N{NO-BREAK SPACE}"  # textwrap does not break lines at it


def text(expression: Expr) -> str:
    """Return an expression as plain text, with decimals of at most twelve digits."""
    result: str = StrPrinter({"full_prec": False}).doprint(_rounded(expression, 1, TUNING.digits))
    return result


def latex(expression: Expr) -> str:
    r"""Return an expression in LaTeX, with \bigl( in place of \left(, which cannot span lines."""
    names = {symbol: _latex_name(symbol.name) for symbol in expression.free_symbols}
    printer = LatexPrinter({"full_prec": False, "mul_symbol": r" \, ", "symbol_names": names})
    formula: str = printer.doprint(_rounded(expression, 1, TUNING.digits))
    return formula.replace(r"\left(", r"\bigl(").replace(r"\right)", r"\bigr)")


def python(expression: Expr) -> str:
    """Return an expression in Python for SymPy: exact, except fractions with more digits than a float."""
    result: str = _PythonPrinter({"sympy_integers": True}).doprint(
        _rounded(expression, 10**FLOAT_DIGITS, FLOAT_DIGITS)
    )
    return result


def lines(formula: str, start: str, width: int, end: str = "") -> list[str]:
    """Return ``start``, a formula and ``end`` as lines of at most ``width`` characters if possible."""
    indent = " " * (len(start) - len(start.lstrip()) + 4)
    # No line break after a sign, nor within angles and short brackets.
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
        """Print a long sum as one call, because Python cannot nest thousands of additions."""
        if len(expression.args) <= TUNING.nested_terms:
            result: str = super()._print_Add(expression, order)
            return result
        return f"Add({', '.join(map(self._print, expression.args))})"


def _rounded(expression: Expr, largest: int, digits: int) -> Expr:
    """Return the expression with decimals for fractions whose numerator or denominator exceeds ``largest``."""
    decimals = {}
    for number in expression.atoms(Rational):
        if not number.is_Integer and max(abs(number.p), number.q) > largest:
            decimals[number] = Float(number, digits)
    # Otherwise SymPy expands products.
    with distribute(False):
        return expression.xreplace(decimals)


def _latex_name(name: str) -> str:
    """Return a name such as ``Izz1R`` in LaTeX: I with the index zz,1R."""
    letter, axes, number = re.findall(r"(.)([a-z]*)(.*)", name)[0]
    index = ",".join(filter(None, [axes, number]))
    return f"{letter}_{{{index}}}" if index else str(letter)
