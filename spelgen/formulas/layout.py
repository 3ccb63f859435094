"""What the three ways of writing formulas down have in common: lines of one width, names, definitions.

Every name in a formula is made here, from numbers; the URDF's names stand in comments, as JSON strings, which
have neither line ends nor control characters.
"""

from __future__ import annotations

import json
import re

from spelgen.formulas.expression import Sum, Symbol, Term
from spelgen.formulas.formulas import Formula, Formulas
from spelgen.structure.base_parameters import BaseParameter, parameter_name

# before a sign, but not inside an angle; behind a comma, but not inside a fraction
_GAP = re.compile(r" (?=[+-] )(?![+-] (?:[\d./]+(?:\*| \\, ))?q)|(?<=,) (?!\d)")


def broken(parts: list[str], start: str, width: int) -> list[str]:
    """``parts`` in lines of at most ``width``, the first after ``start``; long parts break at their signs."""
    lines, indent = [start], " " * (len(start) - len(start.lstrip()) + 4)
    pieces: list[str] = []
    for part in parts:
        room = width - len(indent) if pieces else width - len(start)
        pieces += [part] if len(part) <= room else _GAP.split(part)
    for piece in pieces:
        if len(lines[-1]) + len(piece) > width and lines[-1].strip() != start.strip():
            lines.append(indent)
        lines[-1] += f"{piece} "
    return [line.rstrip() for line in lines]


def definition(parameter: BaseParameter) -> Sum:
    """What a base parameter is the sum of."""
    return Sum(
        tuple(
            Term(coefficient, ((Symbol(parameter_name(index)), 1),))
            for index, coefficient in parameter.weights
        )
    )


def comments(found: Formulas) -> list[str]:
    """Which robot, joints and bodies the numbers in the names stand for."""
    lines = [f"Robot {json.dumps(found.arm.name)}, for {trusted(found)}."]
    lines += [f"q{k + 1}: {json.dumps(each.name)}" for k, each in enumerate(found.arm.coordinates)]
    if [each.name for each in found.arm.bodies] != [each.name for each in found.arm.coordinates]:
        lines += [f"body {k + 1}: {json.dumps(each.name)}" for k, each in enumerate(found.arm.bodies)]
    lines += [f"{formula.name}: {why_not(formula)}" for formula in found.unwritten]
    return lines


def trusted(found: Formulas) -> str:
    """For which inertial values the formulas hold."""
    if found.assume == "kinematics":
        return "any inertial values"
    return "the URDF's inertial zeros and symmetries"


def why_not(formula: Formula) -> str:
    """Why an entry is not written out."""
    if formula.terms is None:
        return "too many terms to be expanded"
    return f"{formula.terms} terms, not written out"
