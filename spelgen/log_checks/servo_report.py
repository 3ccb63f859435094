"""Report what logs of commanded positions hold: tables of commands, and of how joints follow them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from spelgen.labels import UNITS
from spelgen.listing import Listing, number


@dataclass(frozen=True)
class ServoJointReport:
    """Describe one joint over all trajectories [rad, m]; None where it cannot be said.

    q, u: the lowest and the highest. range_fraction: of the joint's range that was visited. noise: of q, standard
    deviation of what changes from sample to sample. steps: of q and u where they are quantised. lag: by which
    positions come after commands [s]. tracking_rms: root mean square of u, delayed by the lag, less q.
    steady_state_error: nine tenths of the distances u - q are smaller while both rest. saturated: fraction of the time
    that kp (u - q) is beyond the effort limit, where the settings say kp.
    """

    name: str
    kind: str
    q: tuple[float, float]
    u: tuple[float, float]
    range_fraction: float | None
    noise: float | None
    steps: dict[str, float | None]
    lag: float | None
    tracking_rms: float
    steady_state_error: float | None
    saturated: float | None


def servo_tables(joints: Sequence[ServoJointReport]) -> tuple[Listing, ...]:
    """Return the tables of an arm under position servos."""
    return _commands(joints), _following(joints)


def _commands(joints: Sequence[ServoJointReport]) -> Listing:
    head = ("joint", "q", "range", "u", "noise", "q step", "u step")
    rows = []
    for joint in joints:
        visited, noise = _format(joint.range_fraction, 1, ".0%"), number(joint.noise)
        steps = number(joint.steps["q"]), number(joint.steps["u"])
        rows.append((joint.name, span(*joint.q), visited, span(*joint.u), noise, *steps))
    kinds = {joint.kind for joint in joints}
    units = "; ".join(unit.position for kind, unit in UNITS.items() if kind in kinds)
    note = (
        "range: how much of the joint's was visited; u: commanded positions; noise: of q, standard deviation of "
        "what changes from sample to sample, from 50 Hz on; step: between the levels of a quantised signal."
    )
    return Listing(f"Positions and commands [{units}]", head, tuple(rows), note)


def _following(joints: Sequence[ServoJointReport]) -> Listing:
    head = ("joint", "lag", "tracking RMS", "steady-state error", "saturated")
    rows = []
    for joint in joints:
        lag, saturated = _format(joint.lag, 1000, ".0f", " ms"), _format(joint.saturated, 1, ".1%")
        tracking = _format(joint.tracking_rms, 1000, ".3g")
        rows.append((joint.name, lag, tracking, _format(joint.steady_state_error, 1000, ".3g"), saturated))
    note = (
        "lag: delay of positions after commands; tracking RMS: delayed command minus position; steady-state error: "
        "90th percentile of the distance from the command at rest [mrad, mm]; saturated: fraction of time with "
        "kp (u - q) beyond the effort limit, if kp is set."
    )
    return Listing("Following", head, tuple(rows), note)


def span(low: float, high: float) -> str:
    """Return both ends of a range."""
    return f"{number(low)} .. {number(high)}"


def _format(value: float | None, factor: float, form: str, unit: str = "") -> str:
    if value is None:
        return "-"
    return f"{factor * value:{form}}{unit}"
