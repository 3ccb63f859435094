"""Closed forms as files: LaTeX to be read in from a document that loads amsmath, and Python that needs SymPy alone.

Every name in a formula is made from numbers; the URDF's names stand in comments only, as JSON strings, which
have neither line ends nor control characters.
"""

from __future__ import annotations

import json
from collections.abc import Iterable

from sympy import Expr, Symbol

from spelgen.certificate.formulas import Formulas
from spelgen.certificate.printing import Latex, Python

_LATEX_WIDTH = 140
_PYTHON_WIDTH = 100

# A docstring first: in a comment of the first two lines a name could pass for the file's encoding (PEP 263).
_HEAD = '''"""Closed forms of a serial arm's mass matrix M(q) and potential energy V(q), by spelgen.

q: the joints' positions [rad, m]. entries: {(row, column): entry of M}, counted from 1, lower triangle.
M: the whole matrix, V: the energy [J] up to a constant; both where nothing is missing.
base_parameters: what each stands for, m being a mass [kg], h = m c a first moment [kg m] and I a tensor
[kg m2] about the joint's origin, in a frame whose z is the joint's axis.
values: what the URDF gives them, where it has inertials.
"""
'''


def latex(found: Formulas) -> str:
    """The formulas and the definitions of their parameters in two ``align*`` environments."""
    rows = [(Symbol(each.name), each.expression) for each in found.rows if each.expression is not None]
    definitions = [each for each in found.base_parameters.items() if not each[1].is_Symbol]
    lines = ["% Closed forms of a serial arm's mass matrix and potential energy, by spelgen; needs amsmath."]
    lines += [f"% {line}" for line in _comments(found)]
    for each in (rows, definitions):
        if each:
            lines += [r"\begin{align*}", " \\\\\n".join(_aligned(each)), r"\end{align*}"]
    return "\n".join(lines) + "\n"


def _aligned(rows: Iterable[tuple[Symbol, Expr]]) -> Iterable[str]:
    printer = Latex()
    for name, expression in rows:
        first, *others = printer.lines(expression, f"{printer.whole(name)} &= ", _LATEX_WIDTH)
        yield from [first, *(rf"    &\quad {line.strip()}" for line in others)]


def sympy_source(found: Formulas) -> str:
    """The text of the file for SymPy."""
    n = len(found.q)
    body = _table("entries", {str(place): entry for place, entry in found.entries.items()})
    if len(found.entries) == n * (n + 1) // 2:
        body.append(f"M = Matrix({n}, {n}, lambda i, j: entries[max(i, j) + 1, min(i, j) + 1])")
    body.append("")
    if found.potential is not None:
        body += ["V = (", *Python().lines(found.potential, "    ", _PYTHON_WIDTH), ")", ""]
    body += _table("base_parameters", found.base_parameters)
    body += _table("values", found.values)
    return "\n".join([_HEAD, *_beginning(found, "\n".join(body)), *body]) + "\n"


def _table(name: str, rows: dict[str, Expr] | dict[Symbol, Expr]) -> list[str]:
    printer = Python()
    lines = [
        printer.lines(expression, f"    {key}: ", _PYTHON_WIDTH, end=",") for key, expression in rows.items()
    ]
    return [f"{name} = {{", *(line for each in lines for line in each), "}"]


def _beginning(found: Formulas, body: str) -> list[str]:
    """Comments, imports of what ``body`` uses, and the symbols."""
    called = ("Add", "Float", "Matrix", "Rational", "cos", "sin")
    imported = [*(name for name in called if f"{name}(" in body), "Symbol"]
    parts = {symbol for each in found.base_parameters.values() for symbol in each.free_symbols}
    positions = [symbol.name for symbol in found.q]
    names = dict.fromkeys([*sorted(symbol.name for symbol in parts), *(each.name for each in found.base)])
    return [
        *(f"# {line}" for line in _comments(found)),
        "",
        f"from sympy import {', '.join(sorted(imported))}",
        "",
        *(f'{name} = Symbol("{name}", real=True)' for name in (*positions, *names)),
        f"q = ({', '.join(positions)}{',' * (len(positions) == 1)})",
        "",
    ]


def _comments(found: Formulas) -> list[str]:
    """Which robot, joints and bodies the numbers in the names stand for."""
    lines = [f"Robot {json.dumps(found.arm.name)}, for {found.trusted}."]
    lines += [f"q{k + 1}: {json.dumps(each.name)}" for k, each in enumerate(found.arm.coordinates)]
    if [each.name for each in found.arm.bodies] != [each.name for each in found.arm.coordinates]:
        lines += [f"body {k + 1}: {json.dumps(each.name)}" for k, each in enumerate(found.arm.bodies)]
    return lines + [f"{each.name}: {each.omission}" for each in found.unwritten]
