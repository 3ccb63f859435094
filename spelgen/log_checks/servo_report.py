"""What `check_logs` found of logs of commanded positions: tables of commands, and of how joints follow them."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from spelgen.listing import Listing, number
from spelgen.log_checks.report import LogReport, clock_table

_UNITS = {"revolute": "rad", "prismatic": "m"}


@dataclass(frozen=True)
class ServoJointReport:
    """One joint over all trajectories [rad, m]; None where it cannot be told.

    q, u: the lowest and the highest. range_fraction: of the joint's range that was visited. noise: of q, standard
    deviation of what changes from sample to sample. steps: of q and u where they are quantised. behind: by which
    positions come after commands [s], with all that makes them late. apart: root mean square of u, so much later, less
    q. still: what is left between them where both rest, nine tenths are nearer. saturated: part of the time that
    kp (u - q) is beyond the effort limit, where the settings tell kp.
    """

    name: str
    kind: str
    q: tuple[float, float]
    u: tuple[float, float]
    range_fraction: float | None
    noise: float | None
    steps: dict[str, float | None]
    behind: float | None
    apart: float
    still: float | None
    saturated: float | None


@dataclass(frozen=True, eq=False, repr=False)
class ServoLogReport(LogReport):
    """delay: between which ends commands act [s], by least squares on the command error; None where nothing moves."""

    servos: tuple[ServoJointReport, ...] = ()
    delay: tuple[float, float] | None = None

    def to_dict(self) -> dict[str, Any]:
        """JSON form, as of logs of torques but for the joints."""
        return super().to_dict() | {"delay": self.delay, "joints": [asdict(each) for each in self.servos]}

    def listings(self, most: int | None = None) -> list[Listing]:
        """All tables; of trajectories at most `most`."""
        return [clock_table(self, most), self._commands(), self._following()]

    def _commands(self) -> Listing:
        head = ("joint", "q", "range", "u", "noise", "q step", "u step")
        rows = tuple(
            (
                x.name, _span(x.q), "-" if x.range_fraction is None else f"{x.range_fraction:.0%}", _span(x.u),
                number(x.noise), number(x.steps["q"]), number(x.steps["u"]),
            )
            for x in self.servos
        )  # fmt: skip
        units = "; ".join(unit for kind, unit in _UNITS.items() if kind in {x.kind for x in self.servos})
        note = (
            "range: how much of the joint's was visited; u: commanded positions; noise: of q, standard deviation of "
            "what changes from sample to sample, from 50 Hz on; step: between the levels of a quantised signal."
        )
        return Listing(f"Positions and commands [{units}]", head, rows, note)

    def _following(self) -> Listing:
        head = ("joint", "behind", "apart", "left at rest", "saturated")
        rows = tuple(
            (
                x.name, "-" if x.behind is None else f"{1000 * x.behind:.0f} ms", f"{1000 * x.apart:.3g}",
                "-" if x.still is None else f"{1000 * x.still:.3g}",
                "-" if x.saturated is None else f"{x.saturated:.1%}",
            )
            for x in self.servos
        )  # fmt: skip
        late = ""
        if self.delay is not None:
            ends = " to ".join(dict.fromkeys(f"{1000 * x:.0f}" for x in self.delay))
            late = f"Commands act after {ends} ms. "
        note = (
            f"{late}behind: by how much positions come after commands; apart: what then is left between them, RMS; "
            "left at rest: what dry friction, dead zone and weight leave between them, nine tenths are nearer [mrad, "
            "mm]; "
            "saturated: part of the time that kp (u - q) is beyond the effort limit, where the settings tell kp."
        )
        return Listing("Following", head, rows, note)


def _span(ends: tuple[float, float]) -> str:
    return f"{number(ends[0])} .. {number(ends[1])}"
