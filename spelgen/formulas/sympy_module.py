"""Closed forms as a Python file that needs SymPy alone."""

from __future__ import annotations

from spelgen.formulas.formulas import Formulas
from spelgen.formulas.layout import broken, comments, definition
from spelgen.formulas.notation import Sympy
from spelgen.structure.base_parameters import parameter_name

# A docstring first: in a comment of the first two lines a name could pass for the file's encoding (PEP 263).
_HEAD = '''"""Closed forms of a serial arm's mass matrix M(q) and potential energy V(q), by spelgen.

q: the joints' positions [rad, m]. entries: {(row, column): entry of M}, counted from 1, lower triangle.
M: the whole matrix, V: the energy [J] up to a constant; both where nothing is missing.
base_parameters: what each stands for, m being a mass [kg], h = m c a first moment [kg m] and I a tensor
[kg m2] about the joint's origin, in a frame whose z is the joint's axis.
values: what the URDF gives them, where it has inertials.
"""
'''
_WIDTH = 100


def sympy_source(found: Formulas) -> str:
    """The text of the file; names from the URDF stand in its comments only."""
    body = [*_entries(found), "", *_potential(found), *_base(found)]
    return "\n".join([_HEAD, *_beginning(found, "\n".join(body)), *body]) + "\n"


def _entries(found: Formulas) -> list[str]:
    notation = Sympy()
    lines = ["entries = {"]
    for formula in found.entries:
        if formula.expression is not None and formula.place is not None:
            row, column = formula.place
            lines += broken(notation.sum(formula.expression), f"    ({row + 1}, {column + 1}): ", _WIDTH)
            lines[-1] += ","
    lines.append("}")
    n = len(found.arm.coordinates)
    written = sum(bool(formula.place and formula.expression is not None) for formula in found.entries)
    if written == n * (n + 1) // 2:
        lines.append(f"M = Matrix({n}, {n}, lambda i, j: entries[max(i, j) + 1, min(i, j) + 1])")
    return lines


def _potential(found: Formulas) -> list[str]:
    for formula in found.entries:
        if formula.place is None and formula.expression is not None:
            return ["V = (", *broken(Sympy().sum(formula.expression), "    ", _WIDTH), ")", ""]
    return []


def _base(found: Formulas) -> list[str]:
    notation = Sympy()
    lines = ["base_parameters = {"]
    for each in found.base:
        lines += broken(notation.sum(definition(each)), f"    {each.name}: ", _WIDTH)
        lines[-1] += ","
    lines += ["}", "values = {"]
    for each in found.base:
        if each.value is not None:
            sign = "-" if each.value < 0 else ""
            lines.append(f"    {each.name}: {sign}{notation.number(abs(each.value))},")
    return [*lines, "}"]


def _beginning(found: Formulas, body: str) -> list[str]:
    """Comments, imports of what ``body`` uses, and the symbols."""
    called = ("Add", "Float", "Matrix", "Rational", "cos", "sin")
    imported = [*(name for name in called if f"{name}(" in body), "Symbol"]
    weights = {index for each in found.base for index, _ in each.weights}
    positions = [f"q{k + 1}" for k in range(len(found.arm.coordinates))]
    names = dict.fromkeys(
        [*(parameter_name(index) for index in sorted(weights)), *(p.name for p in found.base)]
    )
    lines = [
        *(f"# {line}" for line in comments(found)),
        "",
        f"from sympy import {', '.join(sorted(imported))}",
        "",
    ]
    lines += [f'{name} = Symbol("{name}", real=True)' for name in (*positions, *names)]
    return [*lines, f"q = ({', '.join(positions)}{',' * (len(positions) == 1)})", ""]
