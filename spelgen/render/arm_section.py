"""The arm of a page: a picture that plays, and beside it M, whose cells tell what makes them so."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from spelgen.arm.arm import Arm
from spelgen.baselines.names import MODEL
from spelgen.certificate.facts import facts
from spelgen.certificate.formula_text import to_dict
from spelgen.certificate.formulas import Formulas, formulas
from spelgen.labels import entry_name, joint_ranges, joints_in_ranges
from spelgen.render.page import json_data
from spelgen.render.scene import Scene, scene
from spelgen.render.still import PITCH, YAW, still, view
from spelgen.structure.structure import Structure

GHOSTS = 3
LETTERS = {"zero": "0", "constant": "C"}
WORST = 0.5  # relative error that is drawn as the worst colour
IDENTIFIED = {"alone": 1.0, "in combination": 0.5, "never": 0.0}


@dataclass(frozen=True)
class Cell:
    """An entry of M: kind, what stands in it, the joints it depends on (0-based), and all that is to be told."""

    kind: str
    text: str
    joints: tuple[int, ...]
    told: str


@dataclass(frozen=True)
class ArmSection:
    """data: for the script. motions: their names. coloured: what the links can be coloured by."""

    picture: Markup
    data: Markup
    motions: tuple[str, ...]
    coloured: tuple[str, ...]
    found: bool


def matrix(arm: Arm, structure: Structure) -> list[list[Cell]]:
    """M, whole: of each entry what it depends on, why, and its formula where that is short."""
    told = _told(arm, structure, formulas(arm, structure))
    n = len(structure.joints)
    cells = {(x.row, x.column): x for x in structure.entries}
    return [
        [
            Cell(x.kind, LETTERS.get(x.kind, joint_ranges(x.joints)), tuple(x.joints), told[x.row, x.column])
            for x in (cells[max(i, j), min(i, j)] for j in range(n))
        ]
        for i in range(n)
    ]  # fmt: skip


def _told(arm: Arm, structure: Structure, closed: Formulas) -> dict[tuple[int, int], str]:
    """By entry: what it is, the facts that name it, and its formula."""
    every = facts(arm, structure)
    written = {(x["row"], x["col"]): x for x in to_dict(closed)["entries"] if x["row"]}
    found = {}
    for entry in structure.entries:
        name = entry_name(entry.row, entry.column)
        what = {"zero": "is always zero", "constant": "is constant"}.get(entry.kind) or (
            f"depends on {joints_in_ranges(entry.joints)} only"
        )
        lines = [f"{name} {what}."]
        lines += [str(fact) for fact in every if name in re.findall(r"M\d+(?:,\d+)?", fact.statement)]
        idle = [fact for fact in every if fact.statement.startswith("M does not depend")]
        lines += [str(fact) for fact in idle if entry.kind == "varying"]
        formula = written[entry.row + 1, entry.column + 1]
        if formula["expression"]:
            lines.append(f"{name} = {formula['expression']}")
        elif entry.kind != "zero":
            lines.append(
                f"Its formula has {formula['terms'] or 'too many'} terms: `spelgen inspect --entry` writes it."
            )
        found[entry.row, entry.column] = "\n".join(lines)
    return found


def arm_section(
    arm: Arm,
    urdf: Path,
    traces: Mapping[str, Any] | None = None,
    identified: Mapping[str, Any] | None = None,
) -> ArmSection:
    """The arm with the motions of an evaluation's traces, or, without, one through its ranges."""
    names = [coordinate.name for coordinate in arm.coordinates]
    drawn = scene(urdf, names)
    motions = _motions(traces or {}) or [_sweep(arm)]
    for motion in motions:
        poses = motion["q"][:: max(1, len(motion["q"]) // 12)]
        seen = view(drawn, poses)
        motion["middle"] = [round(1000 * x, 1) for x in seen.middle]
        motion["scale"] = round(seen.scale, 2)
        motion["ground"] = round(1000 * _lowest(drawn, poses), 1)
    own = motions[0]["q"]
    ghosts = [own[round(k * (len(own) - 1) / GHOSTS)] for k in range(1, GHOSTS + 1)]
    colours = _identifiability(arm, identified or {})
    data = drawn.to_dict() | {
        "motions": motions,
        "identifiability": colours,
        "yaw": YAW,
        "pitch": PITCH,
    }
    return ArmSection(
        picture=still(
            drawn, view(drawn, [own[0], *ghosts]), own[0], ghosts, f"{arm.name} in {GHOSTS + 1} positions"
        ),
        data=json_data(data),
        motions=tuple(motion["told"] for motion in motions),
        coloured=tuple(
            told
            for told, there in (("error", "error" in motions[0]), ("known", colours is not None))
            if there
        ),
        found=drawn.found,
    )


def _motions(traces: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Predictions, coloured by the error of their positions; then torques, coloured by what is not explained."""
    found = []
    for x in traces.get("trajectories", ()):
        q, predicted = _numbers(x["q"]), _numbers(x["predicted_q"])
        moved = np.ptp(q, axis=0)
        off = np.abs(predicted - q) / np.maximum(moved, 1e-2 * moved.max() + 1e-9) / WORST
        found.append(
            {
                "name": f"prediction {x['which']}",
                "told": f"{x['which']} prediction beside what was measured ({x['trajectory']})",
                "t": x["t"],
                "q": x["q"],
                "predicted": x["predicted_q"],
                "error": _rounded(off),
            }
        )
    for x in traces.get("torques", ()):
        measured, predicted = _numbers(x["measured"]), _numbers(x["predicted"][MODEL])
        scale = np.maximum(measured.std(axis=0), 1e-9)
        found.append(
            {
                "name": f"torque {x['which']}",
                "told": f"residual torque, {x['which']} trajectory ({x['trajectory']})",
                "t": x["t"],
                "q": x["q"],
                "error": _rounded(np.abs(measured - predicted) / scale / WORST),
            }
        )
    return found


def _sweep(arm: Arm) -> dict[str, Any]:
    """Every joint through part of its range, at its own pace."""
    t = np.linspace(0, 12, 121)
    columns = []
    for k, each in enumerate(arm.coordinates):
        low, high = _range(each)
        middle, reach = (low + high) / 2, 0.4 * (high - low)
        columns.append(middle + reach * np.sin(2 * np.pi * t / 12 * (1 + k % 3) + k))
    return {
        "name": "sweep",
        "told": "a motion through the joints' ranges",
        "t": [round(x, 3) for x in t.tolist()],
        "q": np.round(np.array(columns).T, 4).tolist(),
    }


def _range(each: Any) -> tuple[float, float]:
    usual = 1.2 if each.kind == "revolute" else 0.3
    low = -usual if each.lower is None or each.continuous else max(each.lower, -2 * usual)
    high = usual if each.upper is None or each.continuous else min(each.upper, 2 * usual)
    return (low, high) if low < high else (each.lower or 0.0, each.upper or 0.0)


def _identifiability(arm: Arm, identified: Mapping[str, Any]) -> list[float] | None:
    """By joint, 0..1 from known to unknown: which part of its body's ten parameters motion cannot show."""
    how = identified.get("identifiability")
    if not how:
        return None
    values = list(how.values())[: 10 * len(arm.bodies)]
    worst = np.zeros(len(arm.coordinates))
    for k, body in enumerate(arm.bodies):
        seen = np.mean([IDENTIFIED.get(x, 0.0) for x in values[10 * k : 10 * k + 10]])
        worst[body.coordinate] = max(worst[body.coordinate], 1 - seen)
    return [round(float(x), 3) for x in worst]


def _lowest(drawn: Scene, poses: Sequence[Sequence[float]]) -> float:
    """Where the ground is drawn: below all links, at the root where they stay above it."""
    heights = [float(position[2]) for q in poses for _, position in drawn.frames(q)]
    return min([0.0, *heights])


def _rounded(values: np.ndarray) -> list[Any]:
    return [[round(x, 3) if np.isfinite(x) else None for x in row] for row in values.tolist()]


def _numbers(values: Any) -> np.ndarray:
    return np.array(values, dtype=float)
