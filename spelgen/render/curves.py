"""All that a report draws of an evaluation's traces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from spelgen.baselines.names import LEAST_SQUARES, MODEL
from spelgen.evaluation.traces import Traces
from spelgen.labels import named_joints, thousandths
from spelgen.listing import number
from spelgen.render.charts import Chart
from spelgen.render.plots import (
    STYLES,
    Panel,
    eigenvalue_chart,
    energy_chart,
    friction_panels,
    growth_panels,
    mass_panels,
    torque_panels,
    trajectory_panels,
)
from spelgen.spec import Facts


@dataclass
class Curves:
    """Hold all that is drawn of an evaluation's traces, None or empty where there is nothing.

    torques, trajectories: panels by their titles.
    """

    growth: Sequence[Panel] = ()
    torques: dict[str, list[Panel]] = field(default_factory=dict)
    trajectories: dict[str, list[Panel]] = field(default_factory=dict)
    mass: Sequence[Panel] = ()
    eigenvalues: Chart | None = None
    friction: Sequence[Panel] = ()
    energy: Chart | None = None


def curves(traces: Traces, facts: Facts) -> Curves:
    """Return all that can be drawn of these traces."""
    joints = named_joints(facts.joints, facts.joint_types)
    drawn = Curves()
    growth, mass = traces.growth, traces.mass
    if growth is not None:
        growths = {name: (growth, name) for name in growth.relative}
        # bands of all would hide one another
        drawn.growth = growth_panels(growths, STYLES, (MODEL, LEAST_SQUARES))
    for trace in traces.torques:
        title = f"{trace.which.capitalize()} trajectory: {trace.trajectory}"
        drawn.torques[title] = torque_panels(trace, joints)
    # one trajectory is enough to see where energy goes
    for trace in traces.torques[:1]:
        drawn.energy = energy_chart(trace)
    for example in traces.trajectories:
        title = f"{example.which.capitalize()} prediction: {example.trajectory}, "
        if example.start is None:
            title = f"{example.which.capitalize()} log replayed: {example.trajectory}, "
            distance = None if example.error is None else 1000 * example.error
            title += f"{number(distance)} {thousandths(facts.joint_types)} off"
        else:
            title += f"{example.start:.3g} s into it, relative error {number(example.error)}"
        motion = f"prediction {example.which}"
        drawn.trajectories[title] = trajectory_panels(
            {"predicted": example}, {"predicted": "predicted"}, joints, motion
        )
    if mass is not None and mass.by:
        entries = {name: curves.entries for name, curves in mass.by.items()}
        drawn.mass = mass_panels(mass.t, entries, STYLES, facts.joint_types)
        drawn.eigenvalues = eigenvalue_chart(mass)
    if traces.friction is not None:
        drawn.friction = friction_panels(traces.friction, traces.torques, joints)
    return drawn
