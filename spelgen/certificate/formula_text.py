"""Write closed forms as text for a terminal, and as a JSON object."""

from __future__ import annotations

import textwrap

from spelgen.certificate import printing
from spelgen.certificate.formulas import WRITABLE, Formula, Formulas
from spelgen.labels import printable, short_name


def text(formulas: Formulas, width: int = 80) -> str:
    """Return the formulas, what their parameters are, and the parameters' values by the URDF."""
    title = f"{printable(formulas.arm.name)}: closed forms for {formulas.trusted}"
    lines = [*textwrap.wrap(title, width), ""]
    for row in formulas.rows:
        if row.expression is None:
            lines.append(f"{row.name}: {row.omission}")
        else:
            lines += printing.lines(printing.text(row.expression), f"{row.name} = ", width)
    for note in _notes(formulas):
        lines += ["", *textwrap.wrap(note, width)]
    if formulas.base:
        lines += ["", *_parameters(formulas, width), "", *textwrap.wrap(_legend(formulas), width)]
    return "\n".join(lines)


def to_dict(formulas: Formulas) -> dict[str, object]:
    """Return every expression as one line of text, null where it is too long; rows and columns count from 1."""
    base, values = [], formulas.values
    for symbol, definition in formulas.base_parameters.items():
        # JSON has no fractions: programs get the nearest double
        value = float(values[symbol]) if symbol in values else None
        base.append({"name": symbol.name, "definition": printing.text(definition), "value": value})
    return {"entries": list(map(_entry, formulas.rows)), "base_parameters": base}


def _entry(formula: Formula) -> dict[str, object]:
    row = column = text = None
    if formula.entry != "V":
        row, column = formula.entry
    if formula.expression is not None:
        text = printing.text(formula.expression)
    return {"name": formula.name, "row": row, "col": column, "terms": formula.terms, "expression": text}


def _notes(formulas: Formulas) -> list[str]:
    notes = []
    if formulas.rows[-1].entry == "V":
        notes.append("V is determined up to a constant.")
    # one example does: the first that can be had at all
    obtainable = [row for row in formulas.unwritten if row.terms is not None and row.terms <= WRITABLE]
    for row in obtainable[:1]:
        option = ",".join(map(str, row.entry))
        notes.append(
            f"Omitted here: --entry {option} shows {row.name} alone, and -o FILE.py writes all entries for SymPy."
        )
    return notes


def _parameters(formulas: Formulas, width: int) -> list[str]:
    values = formulas.values
    lines = ["Base parameters"]
    if values:
        lines = ["Base parameters, and the URDF's values"]
    for symbol, definition in formulas.base_parameters.items():
        value = f" [{float(values[symbol]):.6g}]" if symbol in values else ""
        # a parameter that stands for itself alone needs no equation
        name = "" if definition.is_Symbol else f"{symbol.name} = "
        lines += printing.lines(printing.text(definition), f"  {name}", width, value)
    return lines


def _legend(formulas: Formulas) -> str:
    bodies: set[int] = set()
    for base in formulas.base:
        bodies.update(index // 10 for index, _ in base.weights)  # ten inertial parameters a body
    names = [f"{body + 1} {short_name(formulas.arm.bodies[body].name)}" for body in sorted(bodies)]
    return (
        "m is the mass [kg], h = m c the first moment [kg m] and I the inertia tensor [kg m2] about the "
        "origin of the joint's frame, turned so that z is the joint's axis, of all that moves rigidly with "
        f"the joint: {', '.join(names)}. q is the joint's position [rad, m]."
    )
