"""Report of `check_logs`: for a terminal, a notebook, a page or a program."""

import textwrap
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial

import numpy as np

from spelgen.arm.arm import Coordinate
from spelgen.errors import Diagnostic, SpelgenError
from spelgen.labels import UNITS, counted
from spelgen.listing import WIDTH, Listing, number
from spelgen.log_checks.statistics import Clock, Statistics
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.unit_checks import velocity_agreement

MEASURES = {"q": "position", "qd": "velocity", "tau": "torque", "u": "position"}


@dataclass(frozen=True)
class GravityFit:
    """Contribution of gravity to the torque of one joint.

    Friction, and the inertia torque of the joint's own acceleration, are first removed by least squares from the torque
    and from the gravity torque of the URDF.

    Attributes:
        explained: fraction (0 to 1) of the torque's variance that gravity explains, for the best inertial parameters;
            None if gravity never loads the joint, if the torque is constant, or if there are too few samples.
        factor: least-squares ratio of the torque to the gravity torque of the URDF.
        correlation: correlation of the torque with the gravity torque of the URDF.
        relative_deviation: standard deviation of the URDF's gravity torque, divided by the standard deviation of the
            torque, both before friction and inertia are removed.
    """

    explained: float | None = None
    factor: float | None = None
    correlation: float | None = None
    relative_deviation: float | None = None


@dataclass(frozen=True)
class JointFollowing:
    """Tracking of the command u of one joint; quantities that are unknown are None.

    Attributes:
        lag: delay of positions after commands [s].
        tracking_rms: root mean square of the difference between the command, delayed by the lag, and q [rad, m].
        steady_state_error: 90th percentile of |u - q| at rest [rad, m].
        saturated: fraction of time in which the servo's torque kp (u - q) exceeds the effort limit.
    """

    lag: float | None = None
    tracking_rms: float | None = None
    steady_state_error: float | None = None
    saturated: float | None = None


@dataclass(frozen=True)
class JointReport:
    """Statistics of one joint over all trajectories, in SI units; unknown statistics are None.

    The dicts have one value per signal, with the keys "q", "qd" and "tau" or, for logs of commands, "q", "qd" and "u".

    Attributes:
        name: name of the joint.
        kind: joint type.
        low, high: lowest and highest value of each signal.
        range_fraction: range of the logged q, divided by the range between the position limits.
        noise: standard deviation of the white noise on each signal; None if all logs are sampled below 50 Hz.
        steps: quantisation step of each signal; None for signals that are not quantised in most trajectories.
        velocity_factor: ratio of dq/dt to qd, by least squares.
        velocity_correlation: correlation of dq/dt and qd.
        gravity: correlation and ratio of the torque and the URDF's gravity torque.
        following: lag and errors with which the position tracks the command; None for logs of torques.
    """

    name: str
    kind: str
    low: dict[str, float]
    high: dict[str, float]
    range_fraction: float | None
    noise: dict[str, float | None]
    steps: dict[str, float | None]
    velocity_factor: float | None
    velocity_correlation: float | None
    gravity: GravityFit = GravityFit()
    following: JointFollowing | None = None

    def largest(self, quantity: str) -> float:
        """Return the largest magnitude of a signal of the joint, "q", "qd", "tau" or "u", in all logs."""
        return max(abs(self.low[quantity]), abs(self.high[quantity]))


@dataclass(frozen=True, eq=False, repr=False)
class LogReport:
    """Report of `check_logs` on the logs of a robot.

    Attributes:
        robot: name of the robot.
        trajectories: sample times of each trajectory.
        joints: statistics of each joint.
        tables: tables of the joints, for display.
        findings: remarks and warnings.
        errors: reasons why the logs cannot be trained on.
        examples: up to two trajectories, which the HTML page of the report plots.
    """

    robot: str
    trajectories: tuple[Clock, ...]
    joints: Sequence[JointReport]
    tables: tuple[Listing, ...]
    findings: tuple[Diagnostic, ...]
    errors: tuple[SpelgenError, ...]
    examples: tuple[Trajectory, ...]

    @property
    def files(self) -> int:
        """Number of files from which the logs were read."""
        return len({clock.file for clock in self.trajectories} - {None})

    @property
    def samples(self) -> int:
        """Number of samples of all logs."""
        return sum(clock.samples for clock in self.trajectories)

    @property
    def duration(self) -> float:
        """Duration of all logs [s]."""
        return sum(clock.duration for clock in self.trajectories)

    @property
    def warnings(self) -> tuple[Diagnostic, ...]:
        """The findings that are warnings, without the remarks."""
        return tuple(x for x in self.findings if x.severity == "warning")

    def to_dict(self) -> dict[str, object]:
        """Return the report in JSON form for other programs; `schema` is the version of the form."""
        return {
            "schema": 3,
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
        """Return one line about the logs: the numbers of files, trajectories and samples, and the duration."""
        files = ""
        if self.files:
            files = f" in {counted(self.files, 'file')}"
        return (
            f"{self.robot}: {counted(len(self.trajectories), 'trajectory')}{files}, "
            f"{self.duration:.4g} s, {counted(self.samples, 'sample')}"
        )

    def listings(self, limit: int | None = None) -> list[Listing]:
        """Return all tables of the report; the table of sample times contains at most `limit` trajectories."""
        return [_clock_table(self.trajectories, limit), *self.tables]

    def _short_listings(self) -> list[Listing]:
        # the table has at most 20 trajectories: a data set of a thousand episodes would fill the terminal
        return self.listings(20)

    def text(self) -> str:
        """Return the report on logs for a terminal, in 80 columns, without the errors."""
        paragraphs = [self.heading(), *map(Listing.text, self._short_listings())]
        wrapped = partial(textwrap.fill, width=WIDTH, initial_indent="  ", subsequent_indent="    ")
        findings = list(map(wrapped, map(str, self.findings)))
        if findings:
            paragraphs.append("\n".join(["Findings", *findings]))
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
        table = Listing(self.heading(), ("", "where", "what"), lines, left=(0, 1, 2))
        return "".join(map(Listing.html, (table, *self._short_listings())))


def joint_report(
    index: int, coordinate: Coordinate, measured: Sequence[Statistics], products: np.ndarray
) -> JointReport:
    """Return the statistics of joint number `index` over all trajectories; fields of gravity and tracking are not set.

    measured: statistics of each trajectory. products: (2n, 2n) Gram matrix of increments of the n positions q and the n
    integrals of qd, summed over all trajectories (see `velocity_products`).
    """
    low, high, noise, steps = {}, {}, {}, {}
    for name in measured[0].signals:
        lows, highs, noises, quanta = np.array([x.signals[name][:, index] for x in measured]).T
        low[name], high[name] = float(lows.min()), float(highs.max())
        # noise and quantisation steps are medians, so that a single trajectory, for example with contacts, does not
        # determine them
        noise[name], steps[name] = _median(noises, 0.0), _median(quanta, 0.5)
    factors, correlations = velocity_agreement(products)
    factor, correlation = factors[index], correlations[index, index]
    visited = None
    # the visited fraction of the range is undefined for a URDF with equal or swapped limits
    if coordinate.limits is not None and coordinate.limits[0] < coordinate.limits[1]:
        visited = (high["q"] - low["q"]) / (coordinate.limits[1] - coordinate.limits[0])
    return JointReport(
        name=coordinate.name,
        kind=coordinate.joint_type,
        low=low,
        high=high,
        range_fraction=visited,
        noise=noise,
        steps=steps,
        velocity_factor=float(factor) if np.isfinite(factor) else None,
        velocity_correlation=float(correlation) if np.isfinite(correlation) else None,
    )


def _median(values: np.ndarray, share: float) -> float | None:
    """Return the median of the finite numbers in `values`, one value of a statistic per trajectory.

    None is returned if at most the fraction `share` of the values is finite.
    """
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) > share * len(values) else None


def _clock_table(trajectories: Sequence[Clock], limit: int | None) -> Listing:
    """Return the table of durations, sample rates, jitter and gaps of at most `limit` trajectories."""
    head = ("trajectory", "samples", "duration", "sample rate", "jitter", "gaps", "longest")
    rows = []
    for clock in trajectories[:limit]:
        longest = f"{clock.longest_gap:.3g} s" if clock.gaps else "-"
        duration, rate = f"{clock.duration:.4g} s", f"{clock.sample_rate:.4g} Hz"
        rows.append(
            (clock.name, str(clock.samples), duration, rate, f"{clock.jitter:.1%}", str(clock.gaps), longest)
        )
    hidden = len(trajectories) - len(rows)
    return Listing("Clock", head, rows, f"and {hidden} more" if hidden else "")


def signal_tables(joints: Sequence[JointReport], quantities: Sequence[str]) -> tuple[Listing, Listing]:
    """Return two tables of the joints: the ranges of the signals `quantities`, and their noise and quantisation steps.

    The first quantity must be "q". In the first table, the column after it is the fraction of the range between the
    joint's position limits that the motion covered.
    """
    ranges, signals = [], []
    for joint in joints:
        spans = [f"{number(joint.low[name])} .. {number(joint.high[name])}" for name in quantities]
        ranges.append((joint.name, spans[0], percent(joint.range_fraction), *spans[1:]))
        numbers = [*map(joint.noise.get, quantities), *map(joint.steps.get, quantities)]
        signals.append((joint.name, *map(number, numbers)))
    units = []
    for kind, unit in UNITS.items():
        if any(joint.kind == kind for joint in joints):
            units.append(", ".join(dict.fromkeys(asdict(unit)[MEASURES[name]] for name in quantities)))
    head = ("joint", quantities[0], "of its range", *quantities[1:])
    columns = [f"{name} {what}" for what in ("noise", "step") for name in quantities]
    commands = "u: commanded positions" if "u" in quantities else ""
    note = (
        "noise: standard deviation between samples, for sample rates from 50 Hz; step: quantisation step; in the "
        "units above."
    )
    return (
        Listing(f"Ranges [{'; '.join(units)}]", head, ranges, commands),
        Listing("Signals", ("joint", *columns), signals, note),
    )


def percent(fraction: float | None, digits: int = 0) -> str:
    """Return a fraction as text in percent, with `digits` decimals; a dash for None."""
    return "-" if fraction is None else f"{fraction:.{digits}%}"
