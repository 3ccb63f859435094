"""Page section about the arm: an animated picture, and the mass matrix M with the reason for each entry's structure."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup

from spelgen.arm.arm import Chain
from spelgen.certificate.facts import Fact, facts
from spelgen.evaluation.plain import Curve, record
from spelgen.evaluation.traces import Traces
from spelgen.labels import MODEL, cell_text, entry_name, joints_in_ranges
from spelgen.render.scene import scene
from spelgen.structure.structure import MassEntry, Structure
from spelgen.templates import json_data


@dataclass(frozen=True)
class Cell:
    """Cell of the table of M, for one entry of M.

    Attributes:
        style: "zero", "constant" or "varying".
        text: "0" for a zero entry, "C" for a constant entry, otherwise the joints on which the entry depends.
        joints: Indices of the joints on whose positions the entry depends.
        explanation: Reason for the structure of the entry.
    """

    style: str
    text: str
    joints: tuple[int, ...]
    explanation: str


@dataclass(frozen=True, eq=False)
class AnimatedMotion:
    """A motion of the arm in the animated picture of a page.

    Attributes:
        name: Identifier by which charts refer to this motion.
        label: Text in the list of motions.
        t: Times, (T,) [s].
        q: Joint positions, (T, n) [rad, m].
        error: Colour values of the links, (T, n), see `_colour`; None: the links have no error colours.
        predicted: Predicted joint positions, (T, n) [rad, m], drawn as a second arm; None: no second arm.
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

    data: shapes of the links and motions, as JSON for the script of the page. motions: labels of the motions.
    tubes: sentence about links without meshes, which are drawn as tubes.
    """

    data: Markup
    motions: tuple[str, ...]
    tubes: str


def matrix(arm: Chain, structure: Structure) -> list[list[Cell]]:
    """Return the table of the mass matrix M for a page: n rows of n cells, one cell per entry of M.

    structure: zero, constant and varying entries of M.
    """
    # `spelgen inspect` prints the same facts, so that pages and the terminal give the same explanation of an entry.
    every_fact = facts(arm, structure)
    cells = {}
    for entry in structure.entries:
        explanation = _explanation(entry, every_fact)
        cell = Cell(entry.kind, cell_text(entry.kind, entry.joints), tuple(entry.joints), explanation)
        cells[entry.row, entry.column] = cells[entry.column, entry.row] = cell
    joints = range(len(structure.joints))
    return [[cells[row, column] for column in joints] for row in joints]


def _explanation(entry: MassEntry, every_fact: Sequence[Fact]) -> str:
    """Return the explanation of an entry of M: its joints, and the facts about the entry among ``every_fact``."""
    name = entry_name(entry.row, entry.column)
    predicates = {"zero": "is always zero", "constant": "is constant"}
    default = f"depends on {joints_in_ranges(entry.joints)} only"
    lines = [f"{name} {predicates.get(entry.kind, default)}."]
    for fact in every_fact:
        # The fact "M does not depend on ..." mentions no entry by name, but is listed for every varying entry, since it
        # applies to all.
        of_all = entry.kind == "varying" and fact.statement.startswith("M does not depend")
        if of_all or name in re.findall(r"M\d+(?:,\d+)?", fact.statement):
            lines.append(str(fact))
    return "\n".join(lines)


def arm_section(arm: Chain, urdf: Path, motions: Sequence[AnimatedMotion] = ()) -> AnimatedArm:
    """Return the animated picture of an arm with the given motions.

    Without motions the arm moves through its joint ranges. urdf: URDF with the shapes of the links.
    """
    shapes = scene(urdf, arm.joint_names)
    motions = motions or [_sweep(arm)]
    data = record(shapes) | {"motions": list(map(record, motions))}
    return AnimatedArm(json_data(data), tuple(motion.label for motion in motions), shapes.tubes)


def evaluated_motions(traces: Traces) -> list[AnimatedMotion]:
    """Return the animated motions of an evaluation: predicted motions, then measured motions with predicted torques.

    The colours of the links show the errors of the predicted positions, or of the predicted torques. traces: curves of
    the evaluation.
    """
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
    """Return colours (T, n) of the links of the animated arm, as numbers, for relative errors (T, n) of its joints.

    A colour is |error| / 0.5: an error of 0.5 has the colour 1. The errors are position errors divided by the extent
    of the motion, or torque residuals divided by the standard deviation of the torque (see `evaluated_motions`).
    """
    return np.asarray((np.abs(error) / 0.5).round(3))


def _sweep(arm: Chain) -> AnimatedMotion:
    """Return a motion of 12 s in which each joint moves sinusoidally about the middle of its range."""
    t = np.linspace(0, 12, 121)
    low, high = np.array([x.working_range for x in arm.coordinates]).T
    # Amplitudes of the motion are at most 1.2 rad and 0.3 m: some URDFs have limits of 100 revolutions, too fast for a
    # picture.
    largest = [0.3 if coordinate.joint_type == "prismatic" else 1.2 for coordinate in arm.coordinates]
    joint = np.arange(len(low))
    # Neighbouring joints have different periods (12, 6 or 4 s), so that their motions can be distinguished. The motion
    # of the arm repeats after 12 s.
    phase = 2 * np.pi / 12 * t[:, None] * (1 + joint % 3) + joint
    q = (low + high) / 2 + np.minimum(0.4 * (high - low), largest) * np.sin(phase)
    return AnimatedMotion("sweep", "a motion through the joints' ranges", t.round(3), q.round(4))
