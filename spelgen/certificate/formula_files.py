"""Write closed forms as files: LaTeX for a document that loads amsmath, and Python that needs SymPy alone.

Every name in a formula is made from numbers; the URDF's names stand in comments only, as JSON strings, which
have neither line ends nor control characters.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping

from sympy import Expr, Symbol

from spelgen.certificate import printing
from spelgen.certificate.formulas import Formulas
from spelgen.certificate.printing import lines, python

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


def latex(formulas: Formulas) -> str:
    """Return the formulas and the definitions of their parameters in two ``align*`` environments."""
    rows, definitions = {}, {}
    for row in formulas.written:
        rows[Symbol(row.name)] = row.expression
    for name, definition in formulas.base_parameters.items():
        if not definition.is_Symbol:
            definitions[name] = definition
    result = ["% Closed forms of a serial arm's mass matrix and potential energy, by spelgen; needs amsmath."]
    result += _comments(formulas, "%")
    for equations in (rows, definitions):
        aligned = []
        for name, expression in equations.items():
            start = f"{printing.latex(name)} &= "
            aligned += lines(printing.latex(expression), start, _LATEX_WIDTH)
        if aligned:
            # what goes on in another line is indented
            body = " \\\\\n".join(re.sub("^ +", r"    &\\quad ", line) for line in aligned)
            result += [r"\begin{align*}", body, r"\end{align*}"]
    return "\n".join(result) + "\n"


def sympy_source(formulas: Formulas) -> str:
    """Return the text of the file for SymPy."""
    n = len(formulas.q)
    body = _table("entries", formulas.entries)
    # a matrix with holes would be wrong without a word
    if formulas.mass_matrix is not None:
        body.append(f"M = Matrix({n}, {n}, lambda i, j: entries[max(i, j) + 1, min(i, j) + 1])")
    body.append("")
    if formulas.potential is not None:
        body += lines(python(formulas.potential), "V = (", _PYTHON_WIDTH, end=")")
    body += _table("base_parameters", formulas.base_parameters)
    body += _table("values", formulas.values)
    return "\n".join([_HEAD, *_beginning(formulas, "\n".join(body)), *body]) + "\n"


def _table(name: str, rows: Mapping[tuple[int, int], Expr] | Mapping[Symbol, Expr]) -> list[str]:
    result = [f"{name} = {{"]
    for key, expression in rows.items():
        result += lines(python(expression), f"    {key}: ", _PYTHON_WIDTH, end=",")
    return [*result, "}"]


def _beginning(formulas: Formulas, body: str) -> list[str]:
    """Return comments, imports of what ``body`` uses, and the symbols."""
    # an import that is not used would fail the linters of whoever takes the file
    imported = sorted({"Symbol", *re.findall(r"\b(Add|Matrix|S|cos|sin)\(", body)})
    inertial: set[str] = set()
    for definition in formulas.base_parameters.values():
        inertial.update(symbol.name for symbol in definition.free_symbols)
    positions = [symbol.name for symbol in formulas.q]
    bases = [base.name for base in formulas.base]
    lines = [*_comments(formulas, "#"), "", f"from sympy import {', '.join(imported)}", ""]
    for name in dict.fromkeys([*positions, *sorted(inertial), *bases]):
        lines.append(f'{name} = Symbol("{name}", real=True)')
    # the last comma makes a tuple of one position too
    return [*lines, f"q = ({', '.join(positions)}{',' * (len(positions) == 1)})", ""]


def _comments(formulas: Formulas, mark: str) -> list[str]:
    """Return which robot, joints and bodies the numbers in the names stand for."""
    arm = formulas.arm
    lines = [f"{mark} Robot {json.dumps(arm.name)}, for {formulas.trusted}."]
    for number, coordinate in enumerate(arm.coordinates, start=1):
        lines.append(f"{mark} q{number}: {json.dumps(coordinate.name)}")
    if tuple(body.name for body in arm.bodies) != arm.joint_names:
        for number, body in enumerate(arm.bodies, start=1):
            lines.append(f"{mark} body {number}: {json.dumps(body.name)}")
    for row in formulas.unwritten:
        lines.append(f"{mark} {row.name}: {row.omission}")
    return lines
