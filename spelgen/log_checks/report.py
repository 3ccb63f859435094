"""Tell what `check_logs` found: for a terminal, a notebook, a page or a program."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import reduce
from operator import add

import numpy as np

from spelgen.arm.arm import Coordinate
from spelgen.errors import Diagnostic, SpelgenError
from spelgen.labels import UNITS, counted
from spelgen.listing import WIDTH, Listing, number
from spelgen.log_checks.gravity import GravityFit
from spelgen.log_checks.servo_report import ServoJointReport, span
from spelgen.log_checks.statistics import Clock, Statistics
from spelgen.logs.trajectory import QUANTITIES, Trajectory
from spelgen.settings.tuning.log_checks import LogCheckTuning

TUNING = LogCheckTuning()
UNFITTED = GravityFit()


@dataclass(frozen=True)
class JointReport:
    """One joint over all trajectories; [rad, m], [rad/s, m/s], [Nm, N]; None where it cannot be told.

    low, high, noise, steps: of q, qd and tau, or of q, qd and commands u. range_fraction: of the joint's range that was
    visited. noise: standard deviation of what changes from sample to sample. steps: of signals that are quantised in
    most trajectories. velocity_factor, velocity_correlation: both 1 where qd is dq/dt.
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
    """What `check_logs` found. errors: why the logs cannot be trained on. examples: trajectories to be drawn.

    joints: of an arm under position servos, how they follow their commands. tables: about the joints.
    """

    robot: str
    trajectories: tuple[Clock, ...]
    joints: Sequence[JointReport | ServoJointReport]
    tables: tuple[Listing, ...]
    findings: tuple[Diagnostic, ...]
    errors: tuple[SpelgenError, ...]
    examples: tuple[Trajectory, ...]

    @property
    def files(self) -> int:
        """How many files the trajectories were read from."""
        return len({clock.file for clock in self.trajectories} - {None})

    @property
    def samples(self) -> int:
        """Of all trajectories."""
        return sum(clock.samples for clock in self.trajectories)

    @property
    def duration(self) -> float:
        """Of all trajectories [s]."""
        return sum(clock.duration for clock in self.trajectories)

    @property
    def warnings(self) -> tuple[Diagnostic, ...]:
        """The findings that are more than remarks."""
        return tuple(x for x in self.findings if x.severity == "warning")

    def to_dict(self) -> dict[str, object]:
        """Return the JSON form, versioned by `schema`."""
        return {
            "schema": 2,
            "robot": self.robot,
            "files": self.files,
            "samples": self.samples,
            "duration": self.duration,
            "trajectories": list(map(asdict, self.trajectories)),
            "joints": list(map(asdict, self.joints)),
            "errors": list(map(str, self.errors)),
            "findings": list(map(Diagnostic.to_dict, self.findings)),
        }

    def heading(self) -> str:
        """Return one line: how much there is."""
        files = ""
        if self.files:
            files = f" in {counted(self.files, 'file')}"
        return (
            f"{self.robot}: {counted(len(self.trajectories), 'trajectory')}{files}, "
            f"{self.duration:.4g} s, {counted(self.samples, 'sample')}"
        )

    def listings(self, limit: int | None = None) -> list[Listing]:
        """Return all tables; of trajectories at most `limit`."""
        return [_clock_table(self.trajectories, limit), *self.tables]

    def text(self) -> str:
        """Return the report for a terminal, in 80 columns; the errors are not in it."""
        paragraphs = [self.heading(), *map(Listing.text, self.listings(TUNING.shown))]
        if self.findings:
            paragraphs.append("\n".join(["Findings", *map(_wrapped, self.findings)]))
        elif not self.errors:
            paragraphs.append("No findings.")
        return "\n\n".join(paragraphs)

    def __repr__(self) -> str:
        warnings = counted(len(self.warnings), "warning")
        return f"<LogReport {self.heading()}; {warnings}, {counted(len(self.errors), 'error')}>"

    def _repr_html_(self) -> str:
        lines: list[tuple[str, ...]] = []
        for finding in self.findings:
            lines.append((finding.severity, finding.where, finding.message))
        for error in self.errors:
            lines.append(("error", "", str(error)))
        table = Listing(self.heading(), ("", "where", "what"), tuple(lines), left=(0, 1, 2))
        return "".join(map(Listing.html, (table, *self.listings(TUNING.shown))))


def joint_report(
    index: int, coordinate: Coordinate, measured: Sequence[Statistics], gravity: GravityFit = UNFITTED
) -> JointReport:
    """Put together what all trajectories show of one joint."""
    low, high, noise, steps = {}, {}, {}, {}
    # the median, since one trajectory with contacts would set the noise of all
    noisy = [x.noise for x in measured if x.noise]
    for name in measured[0].low:
        low[name] = min(float(x.low[name][index]) for x in measured)
        high[name] = max(float(x.high[name][index]) for x in measured)
        steps[name] = _common_step([x.steps[name][index] for x in measured])
        if noisy:
            noise[name] = float(np.median([x[name][index] for x in noisy]))
    agreement = reduce(add, [x.agreement for x in measured])
    return JointReport(
        name=coordinate.name,
        kind=coordinate.kind,
        low=low,
        high=high,
        range_fraction=_range_fraction(coordinate, low["q"], high["q"]),
        noise=noise or None,
        steps=steps,
        velocity_factor=agreement.factor(index) if agreement.xx[index] > 0 else None,
        velocity_correlation=agreement.correlation(index),
        gravity=gravity,
    )


def _common_step(steps: Sequence[float]) -> float | None:
    """Return the step of most trajectories, where the signal is quantised in most of them."""
    finite = [step for step in steps if np.isfinite(step)]
    return float(np.median(finite)) if 2 * len(finite) > len(steps) else None


def _range_fraction(coordinate: Coordinate, low: float, high: float) -> float | None:
    """Return the part of a joint's range that lies between these positions; None where it has no range."""
    if coordinate.limits is None:
        return None
    # limits of a URDF may be equal or swapped
    width = coordinate.limits[1] - coordinate.limits[0]
    return (high - low) / width if width > 0 else None


def torque_tables(joints: Sequence[JointReport]) -> tuple[Listing, ...]:
    """Return the tables of an arm under torques."""
    return _ranges(joints), _signals(joints), _physics(joints)


def _clock_table(trajectories: Sequence[Clock], limit: int | None) -> Listing:
    """Return when samples were taken; of trajectories at most `limit`."""
    head = ("trajectory", "samples", "duration", "sample rate", "jitter", "gaps", "longest")
    rows = []
    # a data set of a thousand episodes would fill the terminal
    for clock in trajectories[:limit]:
        longest = f"{clock.longest_gap:.3g} s" if clock.gaps else "-"
        duration, rate = f"{clock.duration:.4g} s", f"{clock.sample_rate:.4g} Hz"
        rows.append((
            clock.name, str(clock.samples), duration, rate, f"{clock.jitter:.1%}", str(clock.gaps), longest,
        ))  # fmt: skip
    hidden = len(trajectories) - len(rows)
    return Listing("Clock", head, tuple(rows), f"and {hidden} more" if hidden else "")


def _ranges(joints: Sequence[JointReport]) -> Listing:
    head = ("joint", "q", "of its range", "qd", "tau")
    rows = []
    for joint in joints:
        q, qd, tau = (span(joint.low[name], joint.high[name]) for name in QUANTITIES)
        rows.append((joint.name, q, _percent(joint.range_fraction), qd, tau))
    kinds = {joint.kind for joint in joints}
    units = "; ".join(f"{x.position}, {x.velocity}, {x.torque}" for kind, x in UNITS.items() if kind in kinds)
    return Listing(f"Ranges [{units}]", head, tuple(rows))


def _signals(joints: Sequence[JointReport]) -> Listing:
    head = ("joint", "q noise", "qd noise", "tau noise", "q step", "qd step", "tau step")
    rows = []
    for joint in joints:
        noise = map((joint.noise or {}).get, QUANTITIES)
        steps = map(joint.steps.get, QUANTITIES)
        rows.append((joint.name, *map(number, noise), *map(number, steps)))
    note = (
        "noise: standard deviation between samples, for sample rates from 50 Hz; step: quantisation step; in the "
        "units above."
    )
    return Listing("Signals", head, tuple(rows), note)


def _physics(joints: Sequence[JointReport]) -> Listing:
    head = ("joint", "dq/dt : qd", "agree", "gravity in tau", "x URDF")
    rows = []
    for joint in joints:
        fit = joint.gravity
        # beside a low correlation the factor means nothing
        is_seen = abs(fit.correlation or 0) > TUNING.seen
        velocity = number(joint.velocity_factor), number(joint.velocity_correlation)
        rows.append((joint.name, *velocity, _percent(fit.explained), number(fit.factor if is_seen else None)))
    note = (
        "dq/dt : qd and its correlation are 1 where qd is the derivative of q; gravity in tau: part of tau's "
        "variance that gravity explains, beside friction and acceleration; x URDF: ratio to the URDF's gravity "
        "torque."
    )
    return Listing("Physics", head, tuple(rows), note)


def _percent(fraction: float | None) -> str:
    return "-" if fraction is None else f"{fraction:.0%}"


def _wrapped(finding: Diagnostic) -> str:
    return textwrap.fill(str(finding), WIDTH, initial_indent="  ", subsequent_indent="    ")
