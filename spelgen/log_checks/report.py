"""What `check_logs` found: for a terminal, a notebook, a page or a program."""

from __future__ import annotations

import textwrap
from dataclasses import asdict, dataclass
from typing import Any

from spelgen.arm.arm import Coordinate
from spelgen.errors import Diagnostic, SpelgenError
from spelgen.listing import WIDTH, Listing, number
from spelgen.log_checks.gravity import GravityFit
from spelgen.log_checks.statistics import Clock
from spelgen.logs.trajectory import QUANTITIES, Trajectory

SHOWN = 20  # trajectories that a terminal and a notebook show
SEEN = 0.7  # correlation of torque and gravity from which on the one is certainly in the other


_UNITS = {"revolute": "rad, rad/s, Nm", "prismatic": "m, m/s, N"}


@dataclass(frozen=True)
class JointReport:
    """One joint over all trajectories; [rad, m], [rad/s, m/s], [Nm, N]; None where it cannot be told.

    range_fraction: of the joint's range that was visited. noise: standard deviation of what changes from sample
    to sample. steps: of signals that are quantised. velocity_factor, velocity_correlation: both 1 where qd is
    dq/dt.
    """

    name: str
    kind: str
    low: dict[str, float]
    high: dict[str, float]
    range_fraction: float | None
    noise: dict[str, float] | None
    steps: dict[str, float | None]
    velocity_factor: float | None
    velocity_correlation: float | None
    gravity: GravityFit


@dataclass(frozen=True, eq=False, repr=False)
class LogReport:
    """What `check_logs` found. errors: why the logs cannot be trained on. examples: trajectories to be drawn."""

    robot: str
    files: int
    trajectories: tuple[Clock, ...]
    joints: tuple[JointReport, ...]
    findings: tuple[Diagnostic, ...]
    errors: tuple[SpelgenError, ...]
    examples: tuple[Trajectory, ...]

    @property
    def samples(self) -> int:
        """Of all trajectories."""
        return sum(each.samples for each in self.trajectories)

    @property
    def duration(self) -> float:
        """Of all trajectories [s]."""
        return sum(each.duration for each in self.trajectories)

    @property
    def warnings(self) -> tuple[Diagnostic, ...]:
        """The findings that are more than remarks."""
        return tuple(each for each in self.findings if each.severity == "warning")

    def to_dict(self) -> dict[str, Any]:
        """JSON form, versioned by `schema`."""
        return {
            "schema": 2,
            "robot": self.robot,
            "files": self.files,
            "samples": self.samples,
            "duration": self.duration,
            "trajectories": [asdict(each) for each in self.trajectories],
            "joints": [asdict(each) for each in self.joints],
            "errors": [str(each) for each in self.errors],
            "findings": [each.to_dict() for each in self.findings],
        }

    def heading(self) -> str:
        """One line: how much there is."""
        files = f" in {_counted(self.files, 'file', 'files')}" if self.files else ""
        return (
            f"{self.robot}: {_counted(len(self.trajectories), 'trajectory', 'trajectories')}{files}, "
            f"{self.duration:.4g} s, {_counted(self.samples, 'sample', 'samples')}"
        )

    def listings(self, most: int | None = None) -> list[Listing]:
        """All tables; of trajectories at most `most`."""
        return [clock_table(self, most), _ranges(self), _signals(self), _physics(self)]

    def text(self) -> str:
        """For a terminal, in 80 columns; the errors are not in it."""
        parts = [self.heading(), *(table.text() for table in self.listings(SHOWN))]
        if self.findings:
            parts.append("\n".join(["Findings", *map(_wrapped, self.findings)]))
        else:
            parts.append("Nothing is odd.")
        return "\n\n".join(parts)

    def __repr__(self) -> str:
        warnings, errors = len(self.warnings), len(self.errors)
        summary = f"{_counted(warnings, 'warning', 'warnings')}, {_counted(errors, 'error', 'errors')}"
        return f"<LogReport {self.heading()}; {summary}>"

    def _repr_html_(self) -> str:
        lines: list[tuple[str, ...]] = [(each.severity, each.where, each.message) for each in self.findings]
        lines += [("error", "", str(each)) for each in self.errors]
        found = Listing(self.heading(), ("", "where", "what"), tuple(lines), left=(0, 1, 2))
        return "".join(table.html() for table in (found, *self.listings(SHOWN)))


def clock_table(found: LogReport, most: int | None) -> Listing:
    """When samples were taken; of trajectories at most `most`."""
    head = ("trajectory", "samples", "duration", "sample rate", "jitter", "gaps", "longest")
    rows = tuple(
        (
            each.name,
            str(each.samples),
            f"{each.duration:.4g} s",
            f"{each.sample_rate:.4g} Hz",
            f"{each.jitter:.1%}",
            str(each.gaps),
            f"{each.longest_gap:.3g} s" if each.gaps else "-",
        )
        for each in found.trajectories[:most]
    )
    left = len(found.trajectories) - len(rows)
    return Listing("Clock", head, rows, f"and {left} more" if left else "")


def _ranges(found: LogReport) -> Listing:
    head = ("joint", "q", "of its range", "qd", "tau")
    rows = []
    for joint in found.joints:
        spans = [f"{number(joint.low[name])} .. {number(joint.high[name])}" for name in QUANTITIES]
        visited = "-" if joint.range_fraction is None else f"{joint.range_fraction:.0%}"
        rows.append((joint.name, spans[0], visited, *spans[1:]))
    kinds = {joint.kind for joint in found.joints}
    units = "; ".join(text for kind, text in _UNITS.items() if kind in kinds)
    return Listing(f"Ranges [{units}]", head, tuple(rows))


def _signals(found: LogReport) -> Listing:
    head = ("joint", *(f"{name} noise" for name in QUANTITIES), *(f"{name} step" for name in QUANTITIES))
    rows = tuple(
        (
            joint.name,
            *(number((joint.noise or {}).get(name)) for name in QUANTITIES),
            *(number(joint.steps[name]) for name in QUANTITIES),
        )
        for joint in found.joints
    )
    note = (
        "noise: standard deviation of what changes from sample to sample, from 50 Hz on; "
        "step: between the levels of a quantised signal; in the units above."
    )
    return Listing("Signals", head, rows, note)


def _physics(found: LogReport) -> Listing:
    head = ("joint", "dq/dt : qd", "agree", "gravity in tau", "x URDF")
    rows = tuple(
        (
            joint.name,
            number(joint.velocity_factor),
            number(joint.velocity_correlation),
            "-" if joint.gravity.explained is None else f"{joint.gravity.explained:.0%}",
            number(joint.gravity.factor if abs(joint.gravity.correlation or 0) > SEEN else None),
        )
        for joint in found.joints
    )
    note = (
        "dq/dt : qd and its correlation are 1 where qd is the derivative of q; gravity in tau: part of tau's "
        "variance, beside friction and acceleration, that gravity explains; x URDF: how many times the URDF's "
        "own gravity torque that is."
    )
    return Listing("Physics", head, rows, note)


def _wrapped(finding: Diagnostic) -> str:
    summary = f"{finding.severity}: {finding.where}: {finding.message}"
    return textwrap.fill(summary, WIDTH, initial_indent="  ", subsequent_indent="    ")


def _counted(count: int, one: str, many: str) -> str:
    return f"{count} {one if count == 1 else many}"


def range_fraction(coordinate: Coordinate, low: float, high: float) -> float | None:
    """The part of a joint's range that lies between these positions; None where it has no range."""
    if coordinate.continuous or coordinate.lower is None or coordinate.upper is None:
        return None
    width = coordinate.upper - coordinate.lower
    return (high - low) / width if width > 0 else None
