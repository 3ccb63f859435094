"""The arm of a page: a motion in three dimensions, and M, whose cells explain their structure."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup

from spelgen.arm.arm import Arm
from spelgen.baselines.names import MODEL
from spelgen.certificate.facts import facts
from spelgen.certificate.formulas import formulas
from spelgen.certificate.inspection import LETTERS
from spelgen.certificate.printing import text
from spelgen.evaluation.drawn_motions import DrawnMotion
from spelgen.evaluation.plain import Curve, record
from spelgen.evaluation.traces import Traces
from spelgen.labels import entry_name, joint_ranges, joints_in_ranges
from spelgen.render.page import json_data
from spelgen.render.scene import scene
from spelgen.render.tuning import TUNING
from spelgen.structure.nominal import working_range
from spelgen.structure.structure import Structure

KINDS = {"zero": "is always zero", "constant": "is constant"}
WIDEST = {"revolute": 1.2, "prismatic": 0.3}
"""Swings of joints that are shown without an evaluation [rad, m]."""
ENTRY = re.compile(r"M\d+(?:,\d+)?")


@dataclass(frozen=True)
class Cell:
    """An entry of M: kind, what stands in it, the joints it depends on (0-based), and why."""

    kind: str
    text: str
    joints: tuple[int, ...]
    explanation: str


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion for the script: t [s] and q, (T, n). error: by joint, 1 for the worst colour. predicted: of q."""

    name: str
    label: str
    t: Curve
    q: Curve
    error: Curve | None = None
    predicted: Curve | None = None


@dataclass(frozen=True)
class ArmSection:
    """data: for the script. motions: their names."""

    data: Markup
    motions: tuple[str, ...]
    has_meshes: bool


def matrix(arm: Arm, structure: Structure) -> list[list[Cell]]:
    """Return M, both triangles: of each entry what it depends on, why, and its formula where that is short."""
    explanations = _explanations(arm, structure)
    cells = {}
    for entry in structure.entries:
        text = LETTERS.get(entry.kind, joint_ranges(entry.joints))
        name = entry_name(entry.row, entry.column)
        cell = Cell(entry.kind, text, tuple(entry.joints), explanations[name])
        cells[entry.row, entry.column] = cells[entry.column, entry.row] = cell
    rows = []
    for row in range(len(structure.joints)):
        rows.append([cells[row, column] for column in range(len(structure.joints))])
    return rows


def _explanations(arm: Arm, structure: Structure) -> dict[str, str]:
    """Return by the name of an entry what it is, the facts that name it, and its formula."""
    every_fact = facts(arm, structure)
    closed = {formula.name: formula for formula in formulas(arm, structure).rows}
    explanations = {}
    for entry in structure.entries:
        name = entry_name(entry.row, entry.column)
        default = f"depends on {joints_in_ranges(entry.joints)} only"
        lines = [f"{name} {KINDS.get(entry.kind, default)}."]
        for fact in every_fact:
            # joints that M does not depend on are a fact about every entry that varies
            of_all = entry.kind == "varying" and fact.statement.startswith("M does not depend")
            if of_all or name in ENTRY.findall(fact.statement):
                lines.append(str(fact))
        formula = closed[name]
        if formula.expression is not None:
            lines.append(f"{name} = {text(formula.expression)}")
        elif entry.kind != "zero":
            terms = formula.terms or "too many"
            lines.append(f"Its formula has {terms} terms: `spelgen inspect --entry` writes it.")
        explanations[name] = "\n".join(lines)
    return explanations


def arm_section(arm: Arm, urdf: Path, traces: Traces | None = None) -> ArmSection:
    """Return the arm with the motions of an evaluation's traces, or, without, one through its ranges."""
    drawn = scene(urdf, arm.joint_names)
    motions = [_sweep(arm)]
    if traces is not None:
        motions = _motions(traces) or motions
    data = record(drawn) | {"motions": list(map(record, motions))}
    return ArmSection(json_data(data), tuple(motion.label for motion in motions), drawn.has_meshes)


def _motions(traces: Traces) -> list[Motion]:
    """Return predictions, coloured by the error of their positions; then torques, coloured by their residual."""
    motions = []
    for example in traces.trajectories:
        extent = np.ptp(example.q, axis=0)
        # a joint that hardly moved is measured by the motion of the others
        error = (example.predicted_q - example.q) / np.maximum(extent, 1e-2 * extent.max() + 1e-9)
        label = f"{example.which} prediction beside what was measured ({example.trajectory})"
        motions.append(_motion(f"prediction {example.which}", label, example, error, example.predicted_q))
    for trace in traces.torques:
        error = (trace.measured - trace.predicted[MODEL]) / np.maximum(trace.measured.std(axis=0), 1e-9)
        label = f"residual torque, {trace.which} trajectory ({trace.trajectory})"
        motions.append(_motion(f"torque {trace.which}", label, trace, error))
    return motions


def _motion(
    name: str, label: str, drawn: DrawnMotion, error: np.ndarray, predicted: np.ndarray | None = None
) -> Motion:
    """Return a motion coloured by errors relative to the motion or to the torque, 1 for the worst colour."""
    colour = np.abs(error) / TUNING.worst_error
    return Motion(name, label, drawn.t, drawn.q, colour.round(3), predicted)


def _sweep(arm: Arm) -> Motion:
    """Return a motion of every joint through part of its range, at its own pace."""
    t = np.linspace(0, 12, 121)
    low, high = np.array(list(map(working_range, arm.coordinates))).T
    # limits of a hundred turns, as some URDFs have them, would show a blur
    widest = [WIDEST[coordinate.kind] for coordinate in arm.coordinates]
    joint = np.arange(len(low))
    phase = 2 * np.pi / 12 * t[:, None] * (1 + joint % 3) + joint
    q = (low + high) / 2 + np.minimum(0.4 * (high - low), widest) * np.sin(phase)
    return Motion("sweep", "a motion through the joints' ranges", t.round(3), q.round(4))
