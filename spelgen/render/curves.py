"""All that a report draws of an evaluation's traces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from spelgen.labels import named_joints, thousandths
from spelgen.listing import number
from spelgen.render.charts import Chart
from spelgen.render.plots import (
    Limits,
    Panel,
    Record,
    coverage_panels,
    eigenvalue_chart,
    energy_chart,
    friction_panels,
    growth_charts,
    torque_panels,
    trace_mass_panels,
    trajectory_panels,
)
from spelgen.spec import Facts


@dataclass(frozen=True)
class Section:
    """A part of the page: a heading and panels."""

    title: str
    panels: list[Panel]


@dataclass
class Curves:
    """All that is drawn of an evaluation's traces; None or empty where there is nothing."""

    growth: Sequence[Panel] = ()
    torques: list[Section] = field(default_factory=list)
    trajectories: list[Section] = field(default_factory=list)
    mass: Sequence[Panel] = ()
    eigenvalues: Chart | None = None
    along: str = ""
    friction: Sequence[Panel] = ()
    energy: Chart | None = None


def curves(traces: Record, facts: Facts) -> Curves:
    """Return all that can be drawn of these traces."""
    joints = named_joints(facts.joints, facts.joint_types)
    drawn = Curves()
    if traces.get("growth"):
        drawn.growth = growth_charts(traces["growth"])
    torques = traces.get("torques") or []
    for trace in torques:
        title = f"{trace['which'].capitalize()} trajectory: {trace['trajectory']}"
        drawn.torques.append(Section(title, torque_panels(trace, joints)))
    if torques:
        # one trajectory is enough to see where energy goes
        drawn.energy = energy_chart(torques[0])
    for example in traces.get("trajectories", []):
        title = _prediction_title(example, facts)
        drawn.trajectories.append(Section(title, trajectory_panels(example, joints)))
    mass = traces.get("mass") or {}
    if mass.get("by"):
        drawn.mass = trace_mass_panels(mass, facts.joint_types)
        drawn.eigenvalues = eigenvalue_chart(mass)
        drawn.along = str(mass["trajectory"])
    if traces.get("friction"):
        drawn.friction = friction_panels(traces["friction"], torques, joints)
    return drawn


def _prediction_title(example: Record, facts: Facts) -> str:
    kind, name, error = example["which"].capitalize(), example["trajectory"], example["error"]
    if "u" in example:
        return f"{kind} log replayed: {name}, {number(1000 * error)} {thousandths(facts.joint_types)} off"
    return f"{kind} prediction: {name}, {example['start']:.3g} s into it, relative error {number(error)}"


def coverage(traces: Record, identified: Record | None, facts: Facts, limits: Limits) -> list[Panel]:
    """Return histograms of positions and velocities of training and test logs."""
    logs = {"training": (identified or {}).get("coverage"), "test": traces.get("coverage")}
    recorded = {name: covered for name, covered in logs.items() if covered}
    if not recorded:
        return []
    return coverage_panels(recorded, named_joints(facts.joints, facts.joint_types), limits)
