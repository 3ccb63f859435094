"""Page section about the arm: an animated picture, and the mass matrix M with the reason for each entry's structure."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup

from spelgen.arm.arm import Chain
from spelgen.certificate.expressions import text
from spelgen.certificate.facts import facts
from spelgen.certificate.formulas import formulas
from spelgen.certificate.inspection import cell_text
from spelgen.evaluation.plain import Curve, record
from spelgen.evaluation.traces import Traces
from spelgen.labels import MODEL, entry_name, joints_in_ranges
from spelgen.render.scene import scene
from spelgen.structure.structure import Structure
from spelgen.templates import json_data


@dataclass(frozen=True)
class Cell:
    """Cell of the table of M, for one entry of M.

    style: zero, constant or varying. joints: indices of the joints on whose positions the entry depends.
    """

    style: str
    text: str
    joints: tuple[int, ...]
    explanation: str


@dataclass(frozen=True, eq=False)
class AnimatedMotion:
    """A motion of the animated picture: positions q and predicted, (T, n) [rad, m], at times t (T,) [s].

    error: (T, n) errors that colour the links, from 0 to 1 for the whole colour scale. name: identifier that charts of
    this motion refer to. label: text in the list of motions.
    """

    name: str
    label: str
    t: Curve
    q: Curve
    error: Curve | None = None
    predicted: Curve | None = None


@dataclass(frozen=True)
class AnimatedArm:
    """The animated picture of an arm.

    data: JSON for the script. motions: labels of the motions to choose from. tubes: sentence about links without
    meshes, which are drawn as tubes.
    """

    data: Markup
    motions: tuple[str, ...]
    tubes: str


def matrix(arm: Chain, structure: Structure) -> list[list[Cell]]:
    """Return all entries of M, (n, n) cells: each with the joints it depends on, the reason and a short formula."""
    explanations = _explanations(arm, structure)
    cells = {}
    for entry in structure.entries:
        explanation = explanations[entry_name(entry.row, entry.column)]
        cell = Cell(entry.kind, cell_text(entry), tuple(entry.joints), explanation)
        cells[entry.row, entry.column] = cells[entry.column, entry.row] = cell
    joints = range(len(structure.joints))
    return [[cells[row, column] for column in joints] for row in joints]


def _explanations(arm: Chain, structure: Structure) -> dict[str, str]:
    """Return name of an entry of M -> text: the joints it depends on, the facts that mention it, and its formula."""
    # `spelgen inspect` prints the same facts, so that pages and the terminal explain an entry equally.
    every_fact = facts(arm, structure)
    closed = {formula.name: formula for formula in formulas(arm, structure).rows}
    explanations = {}
    predicates = {"zero": "is always zero", "constant": "is constant"}
    for entry in structure.entries:
        name = entry_name(entry.row, entry.column)
        default = f"depends on {joints_in_ranges(entry.joints)} only"
        lines = [f"{name} {predicates.get(entry.kind, default)}."]
        for fact in every_fact:
            # The fact that M does not depend on some joints applies to every varying entry.
            of_all = entry.kind == "varying" and fact.statement.startswith("M does not depend")
            if of_all or name in re.findall(r"M\d+(?:,\d+)?", fact.statement):
                lines.append(str(fact))
        formula = closed[name]
        # Long formulas are omitted: they would fill the page, and `spelgen inspect --formulas` prints them.
        if formula.expression is not None:
            lines.append(f"{name} = {text(formula.expression)}")
        elif entry.kind != "zero":
            terms = formula.terms or "too many"
            lines.append(f"Its formula has {terms} terms: `spelgen inspect --entry` writes it.")
        explanations[name] = "\n".join(lines)
    return explanations


def arm_section(arm: Chain, urdf: Path, motions: Sequence[AnimatedMotion] = ()) -> AnimatedArm:
    """Return the animated arm with its motions; if there are none, with a motion through the joint ranges."""
    shapes = scene(urdf, arm.joint_names)
    motions = motions or [_sweep(arm)]
    data = record(shapes) | {"motions": list(map(record, motions))}
    return AnimatedArm(json_data(data), tuple(motion.label for motion in motions), shapes.tubes)


def evaluated_motions(traces: Traces) -> list[AnimatedMotion]:
    """Return predicted motions, whose colour is the position error, then test motions, coloured by torque residual."""
    motions = []
    for example in traces.trajectories:
        extent = np.ptp(example.q, axis=0)
        # Errors are divided by the joint's extent of motion, but at least by 1 % of the largest extent of all joints.
        error = (example.predicted_q - example.q) / np.maximum(extent, 1e-2 * extent.max() + 1e-9)
        label = f"{example.which} prediction and measured motion ({example.trajectory})"
        curves = (example.t, example.q, _colour(error), example.predicted_q)
        motions.append(AnimatedMotion(f"prediction {example.which}", label, *curves))
    for trace in traces.torques:
        error = (trace.measured - trace.predicted[MODEL]) / np.maximum(trace.measured.std(axis=0), 1e-9)
        label = f"residual torque, {trace.which} trajectory ({trace.trajectory})"
        motions.append(AnimatedMotion(f"torque {trace.which}", label, trace.t, trace.q, _colour(error)))
    return motions


def _colour(error: np.ndarray) -> np.ndarray:
    """Return relative errors (T, n) on the colour scale [0, 1], whose last colour represents an error of 0.5."""
    return np.asarray((np.abs(error) / 0.5).round(3))


def _sweep(arm: Chain) -> AnimatedMotion:
    """Return sines of all joints about the middle of their ranges, with three different periods."""
    t = np.linspace(0, 12, 121)
    low, high = np.array([x.working_range for x in arm.coordinates]).T
    # Amplitudes are at most 1.2 rad and 0.3 m: some URDFs have limits of 100 revolutions, too fast for a picture.
    largest = [0.3 if coordinate.joint_type == "prismatic" else 1.2 for coordinate in arm.coordinates]
    joint = np.arange(len(low))
    # Periods of 12, 6 and 4 s make the motions of neighbouring joints distinguishable; the sum repeats after 12 s.
    phase = 2 * np.pi / 12 * t[:, None] * (1 + joint % 3) + joint
    q = (low + high) / 2 + np.minimum(0.4 * (high - low), largest) * np.sin(phase)
    return AnimatedMotion("sweep", "a motion through the joints' ranges", t.round(3), q.round(4))
