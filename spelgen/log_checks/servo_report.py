"""Report what logs of commanded positions hold: tables of commands, and of how joints follow them."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from spelgen.labels import UNITS
from spelgen.listing import Listing, number
from spelgen.log_checks.report import LogReport, clock_table, span


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

    def signals(self) -> tuple[str, ...]:
        """Return the joint's row among positions and commands."""
        visited = _format(self.range_fraction, 1, ".0%")
        steps = (number(self.steps["q"]), number(self.steps["u"]))
        return (self.name, span(*self.q), visited, span(*self.u), number(self.noise), *steps)

    def following(self) -> tuple[str, ...]:
        """Return the joint's row among lags and distances."""
        return (
            self.name,
            _format(self.lag, 1000, ".0f", " ms"),
            _format(self.tracking_rms, 1000, ".3g"),
            _format(self.steady_state_error, 1000, ".3g"),
            _format(self.saturated, 1, ".1%"),
        )


@dataclass(frozen=True, eq=False, repr=False)
class ServoLogReport(LogReport):
    """Report logs of commanded positions."""

    servos: tuple[ServoJointReport, ...] = ()

    def to_dict(self) -> dict[str, object]:
        """Return the JSON form, as of logs of torques but for the joints."""
        return super().to_dict() | {"joints": list(map(asdict, self.servos))}

    def listings(self, most: int | None = None) -> list[Listing]:
        """Return all tables; of trajectories at most `most`."""
        return [clock_table(self, most), self._commands(), self._following()]

    def _commands(self) -> Listing:
        head = ("joint", "q", "range", "u", "noise", "q step", "u step")
        kinds = {joint.kind for joint in self.servos}
        units = "; ".join(unit.position for kind, unit in UNITS.items() if kind in kinds)
        note = (
            "range: how much of the joint's was visited; u: commanded positions; noise: of q, standard deviation of "
            "what changes from sample to sample, from 50 Hz on; step: between the levels of a quantised signal."
        )
        rows = tuple(map(ServoJointReport.signals, self.servos))
        return Listing(f"Positions and commands [{units}]", head, rows, note)

    def _following(self) -> Listing:
        head = ("joint", "lag", "tracking RMS", "steady-state error", "saturated")
        note = (
            "lag: delay of positions after commands; tracking RMS: delayed command minus position; steady-state error: "
            "90th percentile of the distance from the command at rest [mrad, mm]; saturated: fraction of time with "
            "kp (u - q) beyond the effort limit, if kp is set."
        )
        return Listing("Following", head, tuple(map(ServoJointReport.following, self.servos)), note)


def _format(value: float | None, factor: float, form: str, unit: str = "") -> str:
    if value is None:
        return "-"
    return f"{factor * value:{form}}{unit}"
