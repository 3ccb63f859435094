"""All that a report draws of an evaluation's traces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from spelgen.labels import thousandths
from spelgen.listing import number
from spelgen.render.picture import Picture
from spelgen.render.plots import (
    Panel,
    coverage_panels,
    eigenvalue_chart,
    energy_chart,
    friction_panels,
    growth_charts,
    mass_panels,
    style,
    torque_panels,
    trajectory_panels,
)
from spelgen.spec import Facts

BOTH = (("truth", "measured"), ("predicted", "predicted"))
Limits = Sequence[tuple[float, float] | None]


@dataclass(frozen=True)
class Drawn:
    """A part of the page: a heading, its legend (style, label) and panels."""

    title: str
    key: tuple[tuple[str, str], ...]
    panels: tuple[Panel, ...]


@dataclass(frozen=True)
class Curves:
    """All that is drawn of an evaluation's traces; None or empty where there is nothing."""

    growth: tuple[Panel, ...] = ()
    torques: tuple[Drawn, ...] = ()
    trajectories: tuple[Drawn, ...] = ()
    mass: tuple[Panel, ...] = ()
    eigenvalues: Markup | None = None
    along: str = ""
    friction: tuple[Panel, ...] = ()
    energy: Markup | None = None


def predictors(evaluation: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    """Legend of all that predicts: style and name."""
    horizons = (evaluation or {}).get("horizons") or []
    names = list(horizons[0]["errors"]) if horizons else list((evaluation or {}).get("torque") or {})
    return [(style(name), name) for name in names]


def curves(traces: Mapping[str, Any], facts: Facts, picture: Picture) -> Curves:
    """All that can be drawn of these traces."""
    joints, types = facts.joints, facts.joint_types
    mass = traces.get("mass") or {}
    torques = traces.get("torques") or []
    parts = (
        ("inertia", "inertia"),
        ("coriolis", "Coriolis"),
        ("gravity", "gravity"),
        ("friction", "friction"),
    )
    return Curves(
        growth=tuple(growth_charts(traces["growth"])) if traces.get("growth") else (),
        torques=tuple(
            Drawn(
                f"{x['which'].capitalize()} trajectory: {x['trajectory']}",
                (*BOTH, *parts),
                tuple(torque_panels(x, joints, types)),
            )
            for x in torques
        ),
        trajectories=tuple(_predicted(x, joints, types) for x in traces.get("trajectories", [])),
        mass=tuple(mass_panels(mass, types, picture.rows)) if mass.get("by") else (),
        eigenvalues=eigenvalue_chart(mass) if mass.get("by") else None,
        along=str(mass.get("trajectory", "")),
        friction=tuple(friction_panels(traces["friction"], torques, joints, types))
        if traces.get("friction")
        else (),
        energy=energy_chart(torques[0]) if torques else None,
    )


def _predicted(example: Mapping[str, Any], joints: Sequence[str], types: Sequence[str]) -> Drawn:
    which, name, error = (example[x] for x in ("which", "trajectory", "error"))
    panels = tuple(trajectory_panels(example, joints, types))
    if "u" in example:
        title = f"{which.capitalize()} log replayed: {name}, {number(1000 * error)} {thousandths(types)} off"
        return Drawn(title, (*BOTH, ("hold", "commanded")), panels)
    title = f"{which.capitalize()} prediction: {name}, {example['start']:.3g} s into it, "
    return Drawn(f"{title}relative error {number(error)}", BOTH, panels)


def coverage(
    traces: Mapping[str, Any], identified: Mapping[str, Any] | None, facts: Facts, limits: Limits
) -> list[Panel]:
    """Where training and test logs have been."""
    known = {"training": (identified or {}).get("coverage"), "test": traces.get("coverage")}
    logs = {name: x for name, x in known.items() if x}
    return coverage_panels(logs, facts.joints, facts.joint_types, limits) if logs else []
