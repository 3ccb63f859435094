"""Closed forms as LaTeX, to be read in from a document that loads amsmath."""

from __future__ import annotations

from spelgen.formulas.formulas import Formula, Formulas
from spelgen.formulas.layout import broken, comments, definition
from spelgen.formulas.notation import Latex, Notation

_WIDTH = 100


def latex(found: Formulas) -> str:
    """The formulas and the definitions of their parameters in two ``align*`` environments."""
    notation = Latex()
    rows = [
        _row(notation, _name(formula), notation.sum(formula.expression))
        for formula in found.entries
        if formula.expression is not None
    ]
    definitions = [
        _row(notation, notation.symbol(each.name), notation.sum(definition(each)))
        for each in found.base
        if len(each.weights) > 1
    ]
    lines = ["% Closed forms of a serial arm's mass matrix and potential energy, by spelgen; needs amsmath."]
    lines += [f"% {line}" for line in comments(found)]
    for each in (rows, definitions):
        if each:
            lines += [r"\begin{align*}", " \\\\\n".join(each), r"\end{align*}"]
    return "\n".join(lines) + "\n"


def _name(formula: Formula) -> str:
    if formula.place is None:
        return "V"
    row, column = (place + 1 for place in formula.place)
    return f"M_{{{row}{',' if row > 9 else ''}{column}}}"


def _row(notation: Notation, name: str, parts: list[str]) -> str:
    lines = broken(parts, f"{name} &= ", _WIDTH)
    return " \\\\\n".join([lines[0], *(rf"    &\quad {line.strip()}" for line in lines[1:])])
