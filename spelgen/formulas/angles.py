"""Which angles of an arm can be added up: those of joints whose axes stay parallel."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from math import lcm

from spelgen.arm.arm import Arm
from spelgen.arm.rational import IDENTITY, product
from spelgen.arm.axes import is_plain


@dataclass(frozen=True)
class Run:
    """Turning coordinates whose axes are parallel however the arm moves, each with its sense relative to the
    first.
    """

    joints: tuple[int, ...]
    senses: tuple[int, ...]


def parallel_runs(arm: Arm) -> list[Run]:
    """The turning coordinates by runs of parallel axes; where bodies share coordinates, each for itself."""
    if not is_plain(arm):
        return [Run((joint,), (1,)) for joint in units(arm)]
    runs: list[Run] = []
    since = IDENTITY  # the frame of this joint in that of the last turning one; slides turn nothing
    for joint, body in enumerate(arm.bodies):
        since = product(since, body.rotation)
        if body.kind == "prismatic":
            continue
        cosine = since[2][2]
        if runs and abs(cosine) == 1:
            last = runs[-1]
            runs[-1] = Run((*last.joints, joint), (*last.senses, last.senses[-1] * int(cosine)))
        else:
            runs.append(Run((joint,), (1,)))
        since = IDENTITY
    return runs


def units(arm: Arm) -> dict[int, Fraction]:
    """By turning coordinate, the share of it whose cosine and sine the polynomials hold.

    It is 1 unless mimic joints turn by fractions of the coordinate.
    """
    found: dict[int, Fraction] = {}
    for body in arm.bodies:
        if body.kind == "revolute":
            known = found.get(body.coordinate, Fraction(1))
            found[body.coordinate] = Fraction(1, lcm(known.denominator, body.multiplier.denominator))
    return found
