"""Checks of logs that need no robot: frozen columns, inconsistent velocities, degrees, gaps. Nothing is repaired.

A check is a code, a severity and a function of a subject, registered in CHECKS. Each trajectory is checked
individually, so that only one need be in memory. Package `log_checks` has the checks that need the robot.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

import numpy as np

from spelgen.errors import Diagnostic, LogError, SpelgenError, collect
from spelgen.labels import counted
from spelgen.logs.joint_signals import Advice, JointSignals, is_factor, joint_keys, mapping_line
from spelgen.logs.jump_checks import (
    find_dropouts,
    find_frozen,
    find_held,
    find_jumps,
    find_too_rare,
    find_unsigned_velocity,
)
from spelgen.logs.rates import SLOWEST, is_dense, shows_accelerations
from spelgen.logs.resonance import find_elastic
from spelgen.logs.trajectory import Trajectory, gap_ends
from spelgen.logs.unit_checks import (
    find_time_unit,
    find_units,
    find_wrong_velocity,
    velocity_agreement,
    velocity_products,
)
from spelgen.settings.log_mapping import SCALES

ELASTIC = "elastic-joint"

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

    def add(self, check: Check[Any], found: str | Advice, where: str, file: Path | None = None) -> None:
        """Add the finding of a check; to an error, how to accept it. A finding with a line is an error."""
        do, message = check.do, found if isinstance(found, str) else found.message
        if isinstance(found, Advice):
            do = mapping_line(found.keys)
        elif check.severity != "error":
            self.notes.append(Diagnostic(check.severity, check.code, where, None, message))
            return
        do = f"{do}; --accept {check.code} if it is right"
        self.errors.append(LogError(message, file=file, element=where, expected=check.expected, do=do))


def run_checks(
    checks: Iterable[Check[Subject]], subject: Subject, accepted: Collection[str] = ()
) -> list[tuple[Check[Subject], str | Advice]]:
    """Return the checks with a finding, and their findings; accepted: codes of checks that are omitted."""
    results: dict[str, tuple[Check[Subject], str | Advice]] = {}
    for check in checks:
        # one message per cause: velocities in degrees would also fail the check of derivatives
        if check.code in accepted or not results.keys().isdisjoint(check.unless):
            continue
        found = check.find(subject)
        if found is not None:
            results[check.code] = check, found
    return list(results.values())


def find_no_torques(signals: JointSignals) -> str | None:
    """Find recordings in which the torques of all joints are always 0."""
    trajectory = signals.trajectory
    # reported once, and not for each joint
    if signals.number or not trajectory.tau.size or trajectory.tau.any() or not np.ptp(trajectory.q):
        return None
    return "torques that are all 0 while the arm moves"


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
        "frozen", "error", find_frozen, expected="columns that belong together",
        do="check the logger, and the names of the columns",
    ),
    Check(
        "jumps", "error", find_jumps, unless=("frozen",), expected="signals without jumps",
        do="split recordings that were joined by a column 'trajectory', or check the encoder",
    ),
    Check(
        "dropouts", "error", find_dropouts,
        unless=("frozen", "jumps"), expected="signals without holes and outliers",
        do="write 'dropouts: dropped' under 'logs' in the robot's YAML to drop those rows",
    ),
    Check(
        "degrees", "error", find_units, unless=("jumps",), expected="radians and rad/s",
        do="write 'units' under 'logs' in the robot's YAML, or declare them in the Parquet schema's metadata",
    ),
    Check(
        "time-unit", "error", find_time_unit, unless=("degrees", "frozen"), expected="times in seconds",
        do="state the unit of t as 'units' under 'logs' in the robot's YAML",
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
        "velocity-is-no-derivative", "warning", find_wrong_velocity, expected="dq/dt",
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
        self._results: dict[tuple[str, Check[Any]], list[tuple[str | Advice, str, Path | None]]] = {}
        self._count = 0

    def add(self, trajectory: Trajectory) -> None:
        """Add a trajectory."""
        self._count += 1
        for clock_check, found in run_checks(CLOCK_CHECKS, trajectory, trajectory.accepted):
            self._add(str(found), clock_check, found, trajectory)
        for result, messages in ((REPAIRED, trajectory.repairs), (REMARKED, trajectory.remarks)):
            for message in messages:
                self._add(message, result, message, trajectory)
        products = velocity_products(trajectory)
        self.products += products
        factors, correlations = velocity_agreement(products)
        for k, (joint, kind) in enumerate(zip(self._joints, self._kinds, strict=True)):
            columns = trajectory.q[:, k], trajectory.qd[:, k]
            signals = JointSignals(
                trajectory, k, kind, self._joints, *columns, factors[k], correlations[:, k].tolist()
            )
            for joint_check, found in run_checks(CHECKS, signals, trajectory.accepted):
                self._add(joint, joint_check, found, trajectory)

    def _add(self, group: str, check: Check[Any], found: str | Advice, trajectory: Trajectory) -> None:
        where = f"trajectory {trajectory.name}"
        self._results.setdefault((group, check), []).append((found, where, trajectory.file))

    def findings(self) -> Findings:
        """Return the findings: an error for each check, of all its joints; a note for each joint or message."""
        summary = Findings()
        joints_of: dict[Check[Any], list[str]] = {}
        for (group, check), occurrences in self._results.items():
            found, where, file = occurrences[0]
            # joints at rest are a finding only if they never move
            if check.everywhere and len(occurrences) < self._count:
                continue
            if check.severity == "error" or isinstance(found, Advice):
                joints_of.setdefault(check, []).append(group)
                continue
            place = f"{where}, joint {group!r}" if group in self._joints else where
            summary.add(check, f"{found}{_more(occurrences)}", place, file)
        for check, joints in joints_of.items():
            occurrences = self._results[joints[0], check]
            found, where, file = occurrences[0]
            place = f"{where}, joint {', '.join(map(repr, joints))}"
            if isinstance(found, Advice):
                found = Advice(f"{found.message}{_more(occurrences)}", self._keys(check, joints))
            else:
                found += _more(occurrences)
            summary.add(check, found, place, file)
        return summary

    def _keys(self, check: Check[Any], joints: Sequence[str]) -> dict[str, Any]:
        """Return the keys of the group `logs` that remedy the findings of a check about some joints."""
        keys: dict[str, Any] = {}
        for joint in joints:
            for found, _, _ in self._results[joint, check]:
                if isinstance(found, Advice):
                    keys = _merged(keys, found.keys)
        entries = keys.get("joints", {})
        first: Mapping[str, Any] = entries.get(joints[0], {})
        if first.keys() != {"units"}:
            return keys
        # the unit of a joint that rests, or moves little, is that of most others
        factors, _ = velocity_agreement(self.products)
        ratio = SCALES.get(first["units"].get("qd"), 1.0) / SCALES.get(first["units"].get("q"), 1.0)
        is_linear = self._kinds[self._joints.index(joints[0])] == "prismatic"
        kin = [k for k, kind in enumerate(self._kinds) if (kind == "prismatic") == is_linear]
        for k in kin if 2 * len(joints) > len(kin) else ():
            if np.isnan(factors[k]) or is_factor(factors[k], ratio):
                entries.setdefault(self._joints[k], {"units": dict(first["units"])})
        return joint_keys(entries, self._joints)


def _more(occurrences: Sequence[object]) -> str:
    """Return how many more trajectories show a finding, in brackets."""
    count = len(occurrences) - 1
    return f" (and in {counted(count, 'more trajectory')})" if count else ""


def _merged(keys: Mapping[str, Any], others: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested keys with those of others."""
    result = dict(keys)
    for key, value in others.items():
        known = result.get(key)
        result[key] = _merged(known, value) if isinstance(known, dict) else value
    return result


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
