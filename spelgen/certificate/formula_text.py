"""Closed forms as text for a terminal, and as a JSON object."""

from __future__ import annotations

import textwrap
from typing import Any

from spelgen.certificate.formulas import WRITABLE, Formulas
from spelgen.certificate.printing import Text
from spelgen.labels import printable

_LONGEST_NAME = 36


def text(found: Formulas, width: int = 80) -> str:
    """The formulas, what their parameters are, and the parameters' values by the URDF."""
    lines = [*textwrap.wrap(f"{printable(found.arm.name)}: closed forms for {found.trusted}", width), ""]
    for each in found.rows:
        if each.expression is None:
            lines.append(f"{each.name}: {each.omission}")
        else:
            lines += Text().lines(each.expression, f"{each.name} = ", width)
    lines += _notes(found, width)
    if found.base:
        lines += ["", *_parameters(found, width), "", *_legend(found, width)]
    return "\n".join(lines)


def to_dict(found: Formulas) -> dict[str, Any]:
    """Every expression as one line of text, null where it is too long; rows and columns count from 1."""
    printer = Text()
    entries = [
        {
            "name": each.name,
            "row": each.place and each.place[0] + 1,
            "col": each.place and each.place[1] + 1,
            "terms": each.terms,
            "expression": None if each.expression is None else printer.whole(each.expression),
        }
        for each in found.rows
    ]
    base = [
        {
            "name": symbol.name,
            "definition": printer.whole(definition),
            "value": float(found.values[symbol]) if symbol in found.values else None,
        }
        for symbol, definition in found.base_parameters.items()
    ]
    return {"entries": entries, "base_parameters": base}


def _notes(found: Formulas, width: int) -> list[str]:
    notes = []
    if any(each.place is None for each in found.rows):
        notes.append("V is given up to a constant.")
    long = [each for each in found.unwritten if each.terms is not None and each.terms <= WRITABLE]
    if long:
        place = ",".join(str(k + 1) for k in long[0].place) if long[0].place else "V"
        notes.append(
            f"What is not written out: --entry {place} shows {long[0].name} alone, and -o FILE.py writes a file "
            "for SymPy with all of them."
        )
    return [line for note in notes for line in ["", *textwrap.wrap(note, width)]]


def _parameters(found: Formulas, width: int) -> list[str]:
    values = found.values
    lines = ["Base parameters" + (", and the URDF's values" if values else "")]
    for symbol, definition in found.base_parameters.items():
        value = f" [{float(values[symbol]):.6g}]" if symbol in values else ""
        if definition.is_Symbol:
            lines.append(f"  {symbol.name}{value}")
        else:
            lines += Text().lines(definition, f"  {symbol.name} = ", width, end=value)
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
