"""Closed forms as text for a terminal, and as a JSON object."""

from __future__ import annotations

import textwrap
from typing import Any

from spelgen.formulas.formulas import WRITABLE, Formulas
from spelgen.formulas.layout import broken, definition, trusted, why_not
from spelgen.formulas.notation import Plain
from spelgen.labels import printable

_LONGEST_NAME = 36


def text(found: Formulas, width: int = 80) -> str:
    """The formulas, what their parameters are, and the parameters' values by the URDF."""
    notation = Plain()
    lines = [*textwrap.wrap(f"{printable(found.arm.name)}: closed forms for {trusted(found)}", width), ""]
    for formula in found.entries:
        if formula.expression is None:
            lines.append(f"{formula.name}: {why_not(formula)}")
        else:
            lines += broken(notation.sum(formula.expression), f"{formula.name} = ", width)
    lines += _notes(found, width)
    if found.base:
        lines += ["", *_parameters(found, width), "", *_legend(found, width)]
    return "\n".join(lines)


def to_dict(found: Formulas) -> dict[str, Any]:
    """Every expression as one line of text, null where it is too long; rows and columns count from 1."""
    notation = Plain()
    entries = []
    for formula in found.entries:
        place = (
            {"row": None, "col": None}
            if formula.place is None
            else dict(zip(("row", "col"), (k + 1 for k in formula.place), strict=True))
        )
        expression = None if formula.expression is None else " ".join(notation.sum(formula.expression))
        entries.append({"name": formula.name, **place, "terms": formula.terms, "expression": expression})
    base = [
        {
            "name": each.name,
            "definition": " ".join(notation.sum(definition(each))),
            "value": None if each.value is None else float(each.value),
        }
        for each in found.base
    ]
    return {"entries": entries, "base_parameters": base}


def _notes(found: Formulas, width: int) -> list[str]:
    notes = []
    if any(formula.place is None for formula in found.entries):
        notes.append("V is given up to a constant.")
    long = [formula for formula in found.unwritten if formula.terms is not None and formula.terms <= WRITABLE]
    if long:
        place = "V" if long[0].place is None else ",".join(str(k + 1) for k in long[0].place)
        notes.append(
            f"What is not written out: --entry {place} shows {long[0].name} alone, and -o FILE.py writes a file "
            "for SymPy with all of them."
        )
    return [line for note in notes for line in ["", *textwrap.wrap(note, width)]]


def _parameters(found: Formulas, width: int) -> list[str]:
    notation = Plain()
    known = any(each.value is not None for each in found.base)
    lines = ["Base parameters" + (", and the URDF's values" if known else "")]
    for each in found.base:
        value = [] if each.value is None else [f"[{float(each.value):.6g}]"]
        parts = [] if len(each.weights) == 1 else ["=", *notation.sum(definition(each))]
        lines += broken([*parts, *value], f"  {each.name} ", width)
    return lines


def _legend(found: Formulas, width: int) -> list[str]:
    numbers = sorted({index // 10 for each in found.base for index, _ in each.weights})
    bodies = ", ".join(f"{number + 1} {_short(found.arm.bodies[number].name)}" for number in numbers)
    told = (
        "m is the mass [kg], h = m c the first moment [kg m] and I the inertia tensor [kg m2] about the "
        "origin of the joint's frame, turned so that z is the joint's axis, of all that moves rigidly with "
        f"the joint: {bodies}. q is the joint's position [rad, m]."
    )
    return textwrap.wrap(told, width)


def _short(name: str) -> str:
    return textwrap.shorten(printable(name), _LONGEST_NAME, placeholder="...") or '""'
