"""All that a report draws of an evaluation's traces."""

from __future__ import annotations

from spelgen.baselines.names import LEAST_SQUARES, MODEL
from spelgen.evaluation.traces import Traces
from spelgen.labels import named_joints, thousandths
from spelgen.listing import number
from spelgen.render.plots import (
    STYLES,
    energy_chart,
    friction_panels,
    growth_panels,
    mass_panels,
    torque_panels,
    trajectory_panels,
)
from spelgen.spec import ModelSpec


def curves(traces: Traces, spec: ModelSpec) -> dict[str, object]:
    """Return by section of a page what is drawn there, or None; of torques and trajectories by their titles."""
    joints = named_joints(spec.joint_names, spec.joint_types)
    drawn: dict[str, object] = dict.fromkeys(("growth", "mass", "friction", "energy"))
    growth, mass = traces.growth, traces.mass
    if growth is not None:
        growths = {name: (growth, name) for name in growth.relative}
        # bands of all would hide one another
        drawn["growth"] = growth_panels(growths, STYLES, (MODEL, LEAST_SQUARES))
    if mass is not None and mass.by:
        entries = {name: curves.entries for name, curves in mass.by.items()}
        drawn["mass"] = mass_panels(mass.t, entries, STYLES, spec.joint_types)
    if traces.friction is not None:
        drawn["friction"] = friction_panels(traces.friction, traces.torques, joints)
    if traces.torques:  # one trajectory is enough to see where energy goes
        drawn["energy"] = energy_chart(traces.torques[0])
    torques = {}
    for trace in traces.torques:
        torques[f"{trace.which.capitalize()} trajectory: {trace.trajectory}"] = torque_panels(trace, joints)
    trajectories = {}
    for example in traces.trajectories:
        which = example.which.capitalize()
        if example.start is None:
            distance = None if example.error is None else 1000 * example.error
            off = f"{number(distance)} {thousandths(spec.joint_types)} off"
            title = f"{which} log replayed: {example.trajectory}, {off}"
        else:
            start = f"{example.start:.3g} s into it"
            title = (
                f"{which} prediction: {example.trajectory}, {start}, relative error {number(example.error)}"
            )
        motion, lines = f"prediction {example.which}", {"predicted": example}
        trajectories[title] = trajectory_panels(lines, {"predicted": "predicted"}, joints, motion)
    return drawn | {"torques": torques, "trajectories": trajectories}
