"""Output of closed forms of M and the potential energy V: text, a JSON object, and code for SymPy.

Names of symbols consist of letters and numbers of joints. Names from the URDF occur in files only in comments, as JSON
strings without line ends and control characters.
"""

import json
import re
import textwrap
from collections.abc import Mapping

from sympy import Expr, Symbol

from spelgen.certificate import expressions
from spelgen.certificate.expressions import python
from spelgen.certificate.formulas import WRITABLE, Formulas
from spelgen.labels import printable, short_name

_PYTHON_WIDTH = 100

# A Python file of closed forms starts with the docstring `_HEAD`. Comments with names from the URDF are below it, since
# a comment in the first two lines could declare an encoding (PEP 263).
_HEAD = '''"""Closed forms of a serial arm's mass matrix M(q) and potential energy V(q), by spelgen.

q: the joints' positions [rad, m]. entries: {(row, column): entry of M}, counted from 1, lower triangle.
M: the whole matrix, V: the energy [J] up to a constant; each only if all its expressions are included.
base_parameters: definition of each base parameter, with masses m [kg], first moments h = m c [kg m] and
inertia tensors I [kg m2] about the joint's origin, in a frame whose z axis is the axis of the joint.
values: values of the base parameters in the URDF, if it has the inertials.
"""
'''


def text(formulas: Formulas, width: int = 80) -> str:
    """Return closed forms as text for a terminal: formulas, and base parameters with definitions and URDF values.

    width: largest number of characters per line.
    """
    title = f"{printable(formulas.arm.name)}: closed forms for {formulas.trusted}"
    lines = [*textwrap.wrap(title, width), ""]
    for row in formulas.rows:
        if row.expression is None:
            lines.append(f"{row.name}: {row.omission}")
        else:
            lines += expressions.lines(expressions.text(row.expression), f"{row.name} = ", width)
    for note in _notes(formulas):
        lines += ["", *textwrap.wrap(note, width)]
    if formulas.base:
        lines += ["", *_parameters(formulas, width), "", *textwrap.wrap(_legend(formulas), width)]
    return "\n".join(lines)


def to_dict(formulas: Formulas) -> dict[str, object]:
    """Return closed forms as a JSON object. Rows and columns of M are counted from 1; omitted expressions are null."""
    base, values, entries = [], formulas.values, []
    for symbol, definition in formulas.base_parameters.items():
        # JSON has no fractions: exact values are rounded to floats.
        value = float(values[symbol]) if symbol in values else None
        base.append({"name": symbol.name, "definition": expressions.text(definition), "value": value})
    for formula in formulas.rows:
        row, column = (None, None) if formula.entry == "V" else formula.entry
        indices = {"name": formula.name, "row": row, "col": column, "terms": formula.terms}
        formula_text = None if formula.expression is None else expressions.text(formula.expression)
        entries.append({**indices, "expression": formula_text})
    return {"entries": entries, "base_parameters": base}


def _notes(formulas: Formulas) -> list[str]:
    notes = []
    if formulas.rows[-1].entry == "V":
        notes.append("V is determined up to a constant.")
    writable = [row for row in formulas.unwritten if row.terms is not None and row.terms <= WRITABLE]
    for row in writable[:1]:
        option = ",".join(map(str, row.entry))
        notes.append(
            f"Omitted here: --entry {option} shows only {row.name}, and -o FILE.py writes all entries for SymPy."
        )
    return notes


def _parameters(formulas: Formulas, width: int) -> list[str]:
    values = formulas.values
    lines = ["Base parameters, and the URDF's values" if values else "Base parameters"]
    for symbol, definition in formulas.base_parameters.items():
        value = f" [{float(values[symbol]):.6g}]" if symbol in values else ""
        # A base parameter that equals a single inertial parameter has the name of this parameter: no equation is
        # printed.
        name = "" if definition.is_Symbol else f"{symbol.name} = "
        lines += expressions.lines(expressions.text(definition), f"  {name}", width, value)
    return lines


def _legend(formulas: Formulas) -> str:
    # A body has ten inertial parameters, so index // 10 is the index of the body.
    bodies = {index // 10 for base in formulas.base for index, _ in base.weights}
    names = [f"{body + 1} {short_name(formulas.arm.bodies[body].name)}" for body in sorted(bodies)]
    return (
        "m is the mass [kg], h = m c the first moment [kg m] and I the inertia tensor [kg m2] about the "
        "origin of the joint's frame, turned so that z is the joint's axis, of all that moves rigidly with "
        f"the joint: {', '.join(names)}. q is the joint's position [rad, m]."
    )


def sympy_source(formulas: Formulas) -> str:
    """Return the source of a Python file that defines closed forms as SymPy expressions."""
    n = len(formulas.q)
    body = _table("entries", formulas.entries)
    # The file has no matrix M if one entry of M has no expression.
    if formulas.mass_matrix is not None:
        body.append(f"M = Matrix({n}, {n}, lambda i, j: entries[max(i, j) + 1, min(i, j) + 1])")
    body.append("")
    if formulas.potential is not None:
        body += expressions.lines(python(formulas.potential), "V = (", _PYTHON_WIDTH, end=")")
    body += _table("base_parameters", formulas.base_parameters)
    body += _table("values", formulas.values)
    return "\n".join([_HEAD, *_beginning(formulas, "\n".join(body)), *body]) + "\n"


def _table(name: str, rows: Mapping[tuple[int, int], Expr] | Mapping[Symbol, Expr]) -> list[str]:
    result = [f"{name} = {{"]
    for key, expression in rows.items():
        result += expressions.lines(python(expression), f"    {key}: ", _PYTHON_WIDTH, end=",")
    return [*result, "}"]


def _beginning(formulas: Formulas, body: str) -> list[str]:
    """Return the lines of a Python file before ``body``: comments, the imports that ``body`` needs, and symbols."""
    # Only names that occur in `body` are imported, because linters reject unused imports.
    imported = sorted({"Symbol", *re.findall(r"\b(Add|Matrix|S|cos|sin)\(", body)})
    inertial = {symbol.name for x in formulas.base_parameters.values() for symbol in x.free_symbols}
    positions = [symbol.name for symbol in formulas.q]
    bases = [base.name for base in formulas.base]
    lines = [*_comments(formulas), "", f"from sympy import {', '.join(imported)}", ""]
    for name in dict.fromkeys([*positions, *sorted(inertial), *bases]):
        lines.append(f'{name} = Symbol("{name}", real=True)')
    # A tuple of one element needs a trailing comma in Python.
    return [*lines, f"q = ({', '.join(positions)}{',' * (len(positions) == 1)})", ""]


def _comments(formulas: Formulas) -> list[str]:
    """Return the comments of a Python file: names of robot, joints and bodies, and entries without expression.

    Entries of M, or V, have no expression if their closed forms have too many terms.
    """
    arm = formulas.arm
    lines = [f"# Robot {json.dumps(arm.name)}, for {formulas.trusted}."]
    for number, coordinate in enumerate(arm.coordinates, start=1):
        lines.append(f"# q{number}: {json.dumps(coordinate.name)}")
    if tuple(body.name for body in arm.bodies) != arm.joint_names:
        for number, body in enumerate(arm.bodies, start=1):
            lines.append(f"# body {number}: {json.dumps(body.name)}")
    for row in formulas.unwritten:
        lines.append(f"# {row.name}: {row.omission}")
    return lines
