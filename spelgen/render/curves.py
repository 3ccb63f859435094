"""All that a report draws of an evaluation's traces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup

from spelgen.baselines.names import is_drawn
from spelgen.labels import thousandths
from spelgen.listing import number
from spelgen.render.picture import Picture
from spelgen.render.plots import (
    COMPONENTS,
    Limits,
    Panel,
    Record,
    coverage_panels,
    eigenvalue_chart,
    energy_chart,
    friction_panels,
    growth_charts,
    style,
    torque_panels,
    trace_mass_panels,
    trajectory_panels,
)
from spelgen.spec import Facts

Legend = tuple[tuple[str, str], ...]
"""Style and label of each line."""
BOTH: Legend = (("truth", "measured"), ("predicted", "predicted"))


@dataclass(frozen=True)
class Section:
    """A part of the page: a heading, its legend and panels."""

    title: str
    key: Legend
    panels: list[Panel]


@dataclass
class Curves:
    """All that is drawn of an evaluation's traces; None or empty where there is nothing."""

    growth: Sequence[Panel] = ()
    torques: Sequence[Section] = ()
    trajectories: Sequence[Section] = ()
    mass: Sequence[Panel] = ()
    eigenvalues: Markup | None = None
    along: str = ""
    friction: Sequence[Panel] = ()
    energy: Markup | None = None


def predictors(evaluation: Record) -> list[tuple[str, str]]:
    """Return the legend of all that predicts: style and name."""
    names = evaluation.get("torque", {})
    if evaluation.get("horizons"):
        names = evaluation["horizons"][0]["errors"]
    return [(style(name), name) for name in names if is_drawn(name)]


def curves(traces: Record, facts: Facts, picture: Picture) -> Curves:
    """Return all that can be drawn of these traces."""
    joints, types = facts.joints, facts.joint_types
    drawn = Curves()
    if traces.get("growth"):
        drawn.growth = growth_charts(traces["growth"])
    torques = traces.get("torques") or []
    if torques:
        drawn.torques = [_torques(trace, facts) for trace in torques]
        drawn.energy = energy_chart(torques[0])
    drawn.trajectories = [_prediction(example, facts) for example in traces.get("trajectories", [])]
    mass = traces.get("mass") or {}
    if mass.get("by"):
        drawn.mass = trace_mass_panels(mass, picture.kinds, types)
        drawn.eigenvalues = eigenvalue_chart(mass)
        drawn.along = str(mass["trajectory"])
    if traces.get("friction"):
        drawn.friction = friction_panels(traces["friction"], torques, joints, types)
    return drawn


def _torques(trace: Record, facts: Facts) -> Section:
    title = f"{trace['which'].capitalize()} trajectory: {trace['trajectory']}"
    key = (*BOTH, *((name.lower(), name) for name in COMPONENTS))
    return Section(title, key, torque_panels(trace, facts.joints, facts.joint_types))


def _prediction(example: Record, facts: Facts) -> Section:
    kind, name, error = example["which"].capitalize(), example["trajectory"], example["error"]
    panels = trajectory_panels(example, facts.joints, facts.joint_types)
    if "u" in example:
        title = f"{kind} log replayed: {name}, {number(1000 * error)} {thousandths(facts.joint_types)} off"
        return Section(title, (*BOTH, ("hold", "commanded")), panels)
    title = f"{kind} prediction: {name}, {example['start']:.3g} s into it, relative error {number(error)}"
    return Section(title, BOTH, panels)


def coverage(traces: Record, identified: Record | None, facts: Facts, limits: Limits) -> list[Panel]:
    """Return where training and test logs have been."""
    logs = {"training": (identified or {}).get("coverage"), "test": traces.get("coverage")}
    recorded = {name: covered for name, covered in logs.items() if covered}
    if not recorded:
        return []
    return coverage_panels(recorded, facts.joints, facts.joint_types, limits)
