"""Checks of logs that need no robot: frozen columns, inconsistent velocities, degrees, gaps. Nothing is repaired.

A check is a code, a severity and a function of a subject, registered in CHECKS. Each trajectory is checked
individually, so that only one need be in memory. Package `log_checks` has the checks that need the robot.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

import numpy as np

from spelgen.errors import Diagnostic, LogError, SpelgenError, collect
from spelgen.labels import counted
from spelgen.logs.joint_signals import Advice, JointSignals
from spelgen.logs.jump_checks import (
    find_dropouts,
    find_held,
    find_jumps,
    find_too_rare,
    find_unsigned_velocity,
)
from spelgen.logs.rates import SLOWEST, is_dense, shows_accelerations
from spelgen.logs.resonance import find_elastic
from spelgen.logs.trajectory import Trajectory, gap_ends, split_at_gaps
from spelgen.logs.tuning import SIGNALS
from spelgen.settings.log_mapping import TIMES

DEGREES = 180.0 / np.pi
ELASTIC = "elastic-joint"
TURNS = 4 * np.pi  # [rad] Joints with limits have smaller positions: larger ones are in degrees.

Subject = TypeVar("Subject")


@dataclass(frozen=True)
class Check(Generic[Subject]):
    """Check for one fault of logs.

    find: function that returns the message for a subject; None without a finding. severity: logs with an error cannot
    be trained on. unless: codes of earlier checks whose findings explain this one. everywhere: whether a finding must
    occur in all trajectories. expected, do: of an error.
    """

    code: str
    severity: Literal["info", "warning", "error"]
    find: Callable[[Subject], str | Advice | None]
    unless: tuple[str, ...] = ()
    everywhere: bool = False
    expected: str | None = None
    do: str | None = None


@dataclass(frozen=True)
class Findings:
    """Results of checks: notes, and errors, which prevent training."""

    notes: list[Diagnostic] = field(default_factory=list)
    errors: list[SpelgenError] = field(default_factory=list)

    def add(self, check: Check[Any], message: str, where: str, file: Path | None = None) -> None:
        """Add the message of a check; the message of an error is extended by the option that accepts it."""
        if check.severity == "error":
            do = f"{check.do}; --accept {check.code} if it is right"
            error = LogError(message, file=file, element=where, expected=check.expected, do=do)
            self.errors.append(error)
        else:
            self.notes.append(Diagnostic(check.severity, check.code, where, None, message))


def run_checks(
    checks: Iterable[Check[Subject]], subject: Subject, accepted: Collection[str] = ()
) -> list[tuple[Check[Subject], str]]:
    """Return the checks with a finding, and their messages. accepted: codes of checks that are omitted."""
    results: dict[str, tuple[Check[Subject], str]] = {}
    for check in checks:
        # one message per cause: velocities in degrees would also fail the check of derivatives
        if check.code in accepted or not results.keys().isdisjoint(check.unless):
            continue
        found = check.find(subject)
        if isinstance(found, Advice):
            results[check.code] = replace(check, do=found.do), found.message
        elif found is not None:
            results[check.code] = check, found
    return list(results.values())


def velocity_products(trajectory: Trajectory) -> np.ndarray:
    """Return sums of products (2n, 2n) of increments over several samples: of the integrals of qd, then of q."""
    # imported here, since it takes half a second
    from scipy.integrate import cumulative_trapezoid

    products = np.zeros((2 * trajectory.q.shape[1],) * 2)
    for piece in split_at_gaps(trajectory, shortest=2):
        # over several samples: between neighbouring samples the quantisation of q may be larger than its change
        span = min(SIGNALS.increments, len(piece) - 1)
        integral = cumulative_trapezoid(piece.qd, piece.t, axis=0, initial=0)
        positions = np.concatenate([integral, piece.q], axis=1)
        increments = positions[span:] - positions[:-span]
        products += increments.T @ increments
    return products


def velocity_agreement(products: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return factors (n,) by which qd must be multiplied to be dq/dt, and correlations (n, n).

    Correlation (i, j) is 1 if qd of joint i is proportional to dq/dt of joint j, and NaN if one of them is at rest.
    products: see `velocity_products`.
    """
    n = len(products) // 2
    qd_squares, q_squares = np.split(products.diagonal(), 2)
    sizes = np.outer(np.sqrt(qd_squares), np.sqrt(q_squares))
    correlations = products[:n, n:] / np.where(sizes > 1e-12, sizes, np.nan)
    return products[:n, n:].diagonal() / np.where(qd_squares > 0, qd_squares, np.nan), correlations


def find_degrees(signals: JointSignals) -> str | None:
    """Find revolute joints that were probably recorded in degrees."""
    if signals.kind == "prismatic":
        return None
    if signals.changes_by(DEGREES):
        return f"q that changes {signals.factor:.3g} times as fast as qd says (180/pi is 57.3)"
    if signals.changes_by(1 / DEGREES):
        return f"qd that is {1 / signals.factor:.3g} times as large as q changes (180/pi is 57.3)"
    if np.ptp(signals.q) > TURNS and not signals.turns:
        return f"q from {signals.q.min():.3g} to {signals.q.max():.3g}, more than two turns"
    return None


def find_frozen(signals: JointSignals) -> str | None:
    """Find a position or a velocity that never changes while the other one does."""
    from scipy.integrate import cumulative_trapezoid

    q, qd = signals.q, signals.qd
    if np.ptp(qd) == 0 and np.ptp(q) > SIGNALS.drift:
        return f"qd always {qd[0]:g} while q goes from {q.min():.3g} to {q.max():.3g}"
    # by the trapezoidal rule, so that noise of qd about zero has a small integral
    drift = np.abs(cumulative_trapezoid(qd, signals.trajectory.t)).max(initial=0.0)
    if np.ptp(q) == 0 and drift > SIGNALS.drift:
        return f"q always {q[0]:g} while qd says that it moves by {drift:.3g}"
    return None


def find_time_unit(signals: JointSignals) -> str | Advice | None:
    """Find times that are not in seconds: from a sample rate below 2 Hz, or from the ratio of dq/dt to qd."""
    step = signals.step
    if step > SIGNALS.slowest_step:
        # reported once, and not for each joint
        if signals.number:
            return None
        unit = time_unit(step)
        message = f"a sample every {step:.3g} s"
        if unit is None or signals.trajectory.mapping.units.t != "s":
            return message
        message += f", {1 / (step * TIMES[unit]):.4g} Hz if times are in {unit}"
        return Advice(message, f"write 'units: {{t: {unit}}}' under 'logs' in the robot's YAML")
    for unit in ("ms", "us", "ns"):
        if signals.changes_by(TIMES[unit]):
            message = f"q that changes {signals.factor:.3g} times as fast as qd says: times in {unit}"
            return Advice(message, f"write 'units: {{t: {unit}}}' under 'logs' in the robot's YAML")
    return None


def time_unit(step: float) -> str | None:
    """Return the unit of time in which a step between samples is plausible for a robot's log; None if there is none."""
    for unit, size in TIMES.items():
        if SIGNALS.fastest_step <= step * size <= SIGNALS.slowest_step:
            return unit
    return None


def find_no_torques(signals: JointSignals) -> str | None:
    """Find recordings in which the torques of all joints are always 0."""
    trajectory = signals.trajectory
    # reported once, and not for each joint
    if signals.number or not trajectory.tau.size or trajectory.tau.any() or not np.ptp(trajectory.q):
        return None
    return "torques that are all 0 while the arm moves"


def find_wrong_velocity(signals: JointSignals) -> str | None:
    """Find velocities that are not the derivative of the positions, and a joint or a sign that fits better."""
    factor, correlation, tolerance = signals.factor, signals.correlation, 1 - SIGNALS.agreement
    # times in another unit are a finding of the first joint already
    if signals.step > SIGNALS.slowest_step:
        return None
    if np.isnan(correlation) or (correlation >= SIGNALS.agreement and abs(factor - 1) <= tolerance):
        return None
    advice = ""
    if abs(factor + 1) <= tolerance and correlation < -SIGNALS.agreement:
        # the velocity is correct except for its sign, so q is correct, and its derivative can replace qd
        advice = "; its sense is opposite: write 'velocity: differentiated' under 'logs' in the robot's YAML"
    for joint, fit in zip(signals.joints, signals.correlations, strict=True):
        if fit > max(SIGNALS.agreement, correlation):
            advice = f"; it is the derivative of q of joint {joint!r}: check the names of the columns"
            break
    return f"qd is not dq/dt: the best factor is {factor:.3g}, the correlation {correlation:.3g}{advice}"


def find_constant_torque(signals: JointSignals) -> str | None:
    """Find torques that never change; logs of commands have none."""
    tau = signals.trajectory.tau
    if not tau.size or np.ptp(tau[:, signals.number]) > 0:
        return None
    return f"tau is always {tau[0, signals.number]:g}: right for a joint without a motor only"


def find_rest(signals: JointSignals) -> str | None:
    """Find joints that do not move."""
    if np.ptp(signals.q) > 0:
        return None
    return "does not move: the logs do not excite its dynamics"


def find_gaps(trajectory: Trajectory) -> str | None:
    """Find gaps in the sample times."""
    gaps = len(gap_ends(trajectory.t)) - 2
    if not gaps:
        return None
    return f"{counted(gaps, 'gap')} in time, up to {np.diff(trajectory.t).max():.3g} s long; no window crosses one"


def find_low_rate(trajectory: Trajectory) -> str | None:
    """Find a sample rate that is too low for accelerations, which arms under position servos do not need."""
    rate = trajectory.sample_rate
    if trajectory.u is not None or rate == 0 or is_dense(rate):
        return None
    use = f"too slow for fits to torques, which need {SLOWEST:g} Hz"
    if shows_accelerations(rate):
        use = "interpolated for fits to torques"
    return (
        f"{rate:.3g} Hz: {use}; motion faster than {rate / 2:.3g} Hz, delays below "
        f"{1e3 / rate:.0f} ms and friction where a joint reverses are not visible at this rate"
    )


CLOCK_CHECKS = [
    Check("gap", "info", find_gaps),
    Check("low-rate", "warning", find_low_rate),
]
# reported when a log is read, one message per repair
REPAIRED: Check[Trajectory] = Check("repaired", "warning", lambda trajectory: None)
REMARKED: Check[Trajectory] = Check("as-logged", "info", lambda trajectory: None)
CHECKS: list[Check[JointSignals]] = [
    Check(
        "jumps", "error", find_jumps, expected="signals without jumps",
        do="split recordings that were joined by a column 'trajectory', or check the encoder",
    ),
    Check(
        "dropouts", "error", find_dropouts,
        unless=("jumps",), expected="signals without holes and outliers",
        do="write 'dropouts: dropped' under 'logs' in the robot's YAML to drop those rows",
    ),
    Check(
        "degrees", "error", find_degrees, unless=("jumps",), expected="radians and rad/s",
        do="convert degrees, by 'units' under 'logs' in the robot's YAML; if the units are right, declare them there, "
        "or in the Parquet schema's metadata 'units'",
    ),
    Check(
        "frozen", "error", find_frozen, expected="columns that belong together",
        do="check the logger, and the names of the columns",
    ),
    Check(
        "time-unit", "error", find_time_unit, unless=("degrees", "frozen"), expected="times in seconds",
        do="write 'units: {t: ms}' (us, ns) under 'logs' in the robot's YAML",
    ),
    Check(
        "held-samples", "error", find_too_rare, unless=("time-unit",),
        expected=f"values that change {SLOWEST:g} times a second",
        do="log the measurements when they are new, and not the last ones again",
    ),
    Check("held-values", "warning", find_held, unless=("held-samples", "time-unit")),
    Check(
        "velocity-without-sign", "error", find_unsigned_velocity, unless=("degrees", "time-unit", "frozen"),
        expected="dq/dt", do="write 'velocity: differentiated' under 'logs' in the robot's YAML: velocities are then "
        "those of q",
    ),
    Check(
        "no-torques", "error", find_no_torques, everywhere=True, expected="the torques that moved it",
        do="check the names of the columns and the logger",
    ),
    Check(
        "velocity-is-no-derivative", "warning", find_wrong_velocity,
        unless=("degrees", "time-unit", "dropouts", "jumps", "held-samples", "velocity-without-sign"),
    ),
    Check(ELASTIC, "warning", find_elastic, unless=("degrees", "time-unit", "frozen", "dropouts", "jumps")),
    Check("constant-torque", "warning", find_constant_torque, unless=("no-torques",), everywhere=True),
    Check("joint-at-rest", "info", find_rest, unless=("frozen",), everywhere=True),
]  # fmt: skip


class LogChecks:
    """Checks of logs without their robot, one trajectory at a time, so that only one need be in memory.

    products: of all velocities and positions, see `velocity_products`.
    """

    def __init__(self, joints: Sequence[str], joint_types: Sequence[str]) -> None:
        self.products = np.zeros((2 * len(joints),) * 2)
        self._joints, self._kinds = joints, joint_types
        self._results: dict[tuple[str, Check[Any]], list[tuple[str, str, Path | None]]] = {}
        self._count = 0

    def add(self, trajectory: Trajectory) -> None:
        """Add a trajectory."""
        self._count += 1
        where = f"trajectory {trajectory.name}"
        for clock_check, message in run_checks(CLOCK_CHECKS, trajectory, trajectory.accepted):
            self._add(message, clock_check, message, where, trajectory)
        for result, messages in ((REPAIRED, trajectory.repairs), (REMARKED, trajectory.remarks)):
            for message in messages:
                self._add(message, result, message, where, trajectory)
        products = velocity_products(trajectory)
        self.products += products
        factors, correlations = map(np.ndarray.tolist, velocity_agreement(products))
        for k, (joint, kind) in enumerate(zip(self._joints, self._kinds, strict=True)):
            columns = trajectory.q[:, k], trajectory.qd[:, k]
            signals = JointSignals(trajectory, k, kind, self._joints, *columns, factors[k], correlations[k])
            for joint_check, message in run_checks(CHECKS, signals, trajectory.accepted):
                self._add(joint, joint_check, message, f"{where}, joint {joint!r}", trajectory)

    def _add(self, group: str, result: Check[Any], message: str, where: str, trajectory: Trajectory) -> None:
        self._results.setdefault((group, result), []).append((message, where, trajectory.file))

    def findings(self) -> Findings:
        """Return the findings: one per joint and check; of checks of clocks, one per message."""
        summary = Findings()
        for (_, result), occurrences in self._results.items():
            # joints at rest are a finding only if they never move
            if result.everywhere and len(occurrences) < self._count:
                continue
            message, where, file = occurrences[0]
            if len(occurrences) > 1:
                message += f" (and in {counted(len(occurrences) - 1, 'more trajectory')})"
            summary.add(result, message, where, file)
        return summary


def check(
    trajectories: Iterable[Trajectory], joints: Sequence[str], joint_types: Sequence[str]
) -> list[Diagnostic]:
    """Return the findings of the checks of logs; nothing is repaired.

    Raises LogError if revolute joints were probably recorded in degrees, unless units are declared, and if a position
    or a velocity is constant while the other one changes.
    """
    checks = LogChecks(joints, joint_types)
    for trajectory in trajectories:
        checks.add(trajectory)
    summary = checks.findings()
    collect(summary.errors)
    return summary.notes
