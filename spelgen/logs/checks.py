"""Checks of logs that need no robot: frozen columns, wrong velocities, degrees, gaps. The logs are not changed.

A check consists of a code, a severity and a function of the checked object, and is registered in CHECKS. Trajectories
are checked one at a time, so that only one of them need be in memory. The checks that need the robot are in the package
`log_checks`.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

import numpy as np

from spelgen.errors import Diagnostic, LogError, collect
from spelgen.labels import counted
from spelgen.logs.fingerprints import Fingerprints
from spelgen.logs.joint_signals import (
    Advice,
    JointSignals,
    find_dropouts,
    find_elastic,
    find_frozen,
    find_jumps,
    find_words,
    is_factor,
    joint_keys,
    mapping_line,
)
from spelgen.logs.trajectory import Trajectory, gap_ends
from spelgen.logs.tuning import SIGNALS, SLOWEST, is_dense, shows_accelerations
from spelgen.logs.unit_checks import (
    find_copied,
    find_held,
    find_time_unit,
    find_too_rare,
    find_units,
    find_unsigned_velocity,
    find_wrong_velocity,
    velocity_agreement,
    velocity_products,
)
from spelgen.settings.log_mapping import SCALES

ELASTIC, WRONG_VELOCITY = "elastic-joint", "velocity-is-no-derivative"
# Advice for a fault of some recordings: settings that correct these recordings would be wrong for the others.
OF_ONE = "the other recordings do not have this fault: correct this one, or omit it"

Subject = TypeVar("Subject")


@dataclass(frozen=True)
class Check(Generic[Subject]):
    """Check for one fault of logs.

    Attributes:
        code: name of the check in reports; the option `--accept CODE` omits the check.
        severity: logs with a finding of severity "error" cannot be trained on.
        find: function of the checked object that returns a message about the fault, or None if there is no fault. The
            default finds nothing, for checks whose messages are computed elsewhere.
        unless: codes of earlier checks whose findings would explain this fault, too: if one of them has a finding, this
            check is omitted.
        everywhere: if True, a fault is reported only if it occurs in all trajectories.
        expected: expected content of the log, for the error message.
        do: advice for correcting the fault, for the error message.
    """

    code: str
    severity: Literal["info", "warning", "error"]
    find: Callable[[Subject], str | Advice | None] = lambda subject: None
    unless: tuple[str, ...] = ()
    everywhere: bool = False
    expected: str | None = None
    do: str | None = None


# Type of a check of any subject. A check is of a trajectory or of the signals of a joint; one dict of `LogChecks`
# contains the findings of both kinds.
AnyCheck = Check[Any]


@dataclass
class Findings:
    """Findings of checks of logs: errors, which prevent training, and notes, which do not.

    guessed: names of joints whose unit of positions is concluded from their range only, so that the torques may show
    another one.
    """

    notes: list[Diagnostic] = field(default_factory=list)
    errors: list[LogError] = field(default_factory=list)
    guessed: set[str] = field(default_factory=set)

    def extend(self, findings: Iterable[Diagnostic | LogError]) -> None:
        """Add findings: instances of `Diagnostic` to the notes, and exceptions to the errors."""
        for finding in findings:
            if isinstance(finding, Diagnostic):
                self.notes.append(finding)
            else:
                self.errors.append(finding)

    def add(
        self,
        check: AnyCheck,
        message: str,
        where: str,
        file: Path | None = None,
        keys: Mapping[str, object] | None = None,
        is_partial: bool = False,
    ) -> None:
        """Add the message of a check, as an error or as a note according to the check's severity.

        where: trajectory or joints with the fault, for the message. file: path of the log. keys: settings of the group
        `logs` that correct the fault. A fault with such a correction is always an error, so that no model is trained on
        the log without the correction. is_partial: True if other recordings lack the fault, so that `keys` may be wrong
        for them; the advice then includes this condition.
        """
        if not keys and check.severity != "error":
            self.notes.append(Diagnostic(check.severity, check.code, where, None, message))
            return
        do = mapping_line(keys) if keys else check.do
        if is_partial:
            do = f"{do} if this is true of all recordings; else correct this one, or omit it"
        codes = (check.code,)
        error = LogError(message, file=file, element=where, expected=check.expected, do=do, codes=codes)
        self.errors.append(error)


def run_checks(
    checks: Iterable[Check[Subject]], subject: Subject, accepted: Collection[str] = ()
) -> list[tuple[Check[Subject], Advice]]:
    """Return (check, finding) for each check that finds a fault of `subject`, a trajectory or the signals of a joint.

    accepted: codes of checks to omit.
    """
    results: dict[str, tuple[Check[Subject], Advice]] = {}
    for check in checks:
        # A check is omitted if the finding of an earlier check explains the fault. Example: velocities in degrees per
        # second are reported as such, and not again as velocities that differ from dq/dt.
        if check.code in accepted or not results.keys().isdisjoint(check.unless):
            continue
        advice = check.find(subject)
        if advice is not None:
            results[check.code] = check, Advice(advice) if isinstance(advice, str) else advice
    return list(results.values())


def find_no_torques(signals: JointSignals) -> str | None:
    """Return a message if the torques of all joints are 0 throughout a trajectory in which the arm moves."""
    trajectory = signals.trajectory
    # Torques that are all 0 are a fault of all joints, which is reported only once, for joint 0.
    if signals.number or not trajectory.tau.size or trajectory.tau.any() or not np.ptp(trajectory.q):
        return None
    return "torques that are all 0 while the arm moves"


def find_constant_torque(signals: JointSignals) -> str | None:
    """Return a message if the torque of the joint is constant; None for logs without torques (position commands)."""
    tau = signals.trajectory.tau
    if not tau.size or len(tau) == 1 or np.ptp(tau[:, signals.number]) > 0:
        return None
    return f"tau is always {tau[0, signals.number]:g}: right for a joint without a motor only"


def find_rest(signals: JointSignals) -> str | None:
    """Return a message if the joint does not move in the trajectory."""
    if not signals.is_at_rest:
        return None
    return "does not move: the logs do not excite its dynamics"


def find_gaps(trajectory: Trajectory) -> str | None:
    """Return a message if there are gaps in the sample times: time steps longer than four median steps."""
    gaps = len(gap_ends(trajectory.t)) - 2
    if not gaps:
        return None
    return f"{counted(gaps, 'gap')} in time, up to {np.diff(trajectory.t).max():.3g} s long; no window crosses one"


def find_low_rate(trajectory: Trajectory) -> str | None:
    """Return a message if the sample rate is below 50 Hz: accelerations are then inaccurate or cannot be computed.

    Return None for logs of position commands, whose fits do not need accelerations.
    """
    rate = trajectory.sample_rate
    # Times that correspond to less than 2 Hz are probably in another unit than seconds: `find_time_unit` reports them.
    if trajectory.u is not None or rate * SIGNALS.slowest_step < 1 or is_dense(rate):
        return None
    use = f"too slow for fits to torques, which need {SLOWEST:g} Hz"
    if shows_accelerations(rate):
        use = "interpolated for fits to torques"
    return (
        f"{rate:.3g} Hz: {use}; motion faster than {rate / 2:.3g} Hz, delays below "
        f"{1e3 / rate:.0f} ms and friction where a joint reverses are not visible at this rate"
    )


CLOCK_CHECKS = [Check("gap", "info", find_gaps), Check("low-rate", "warning", find_low_rate)]
# REPAIRED and REMARKED check nothing. They are the code and severity of messages that the reader of the log has written
# about changed rows (REPAIRED) or about properties of the file (REMARKED).
REPAIRED: Check[Trajectory] = Check("repaired", "warning")
REMARKED: Check[Trajectory] = Check("as-logged", "info")
# This check compares a trajectory with earlier ones: `LogChecks` computes its message.
REPEATED: Check[Trajectory] = Check("repeated-samples", "warning")
CHECKS: list[Check[JointSignals]] = [
    # Register words (raw integers that overflow, or have a sign bit) are searched first. The jumps of such a signal
    # make dq/dt differ from qd, which the check "frozen" would otherwise report as a frozen signal.
    Check("jumps", "error", find_words, expected="signals without jumps"),
    Check(
        "frozen", "error", find_frozen, unless=("jumps",), expected="columns that belong together",
        do="check the logger, and the names of the columns",
    ),
    Check(
        "jumps", "error", find_jumps, unless=("frozen", "jumps"), expected="signals without jumps",
        do="split recordings that were joined by a column 'trajectory', or check the encoder",
    ),
    Check(
        "dropouts", "error", find_dropouts,
        unless=("frozen", "jumps"), expected="signals without holes and outliers",
        do="write 'dropouts: dropped' under 'logs' in the robot's YAML to drop those rows",
    ),
    Check(
        "degrees", "error", find_units, unless=("jumps",), expected="rad and rad/s, m and m/s",
        do="write 'units' under 'logs' in the robot's YAML, or declare them in the Parquet schema's metadata; "
        "positions of a motor before a gear are counts, with 'counts_per_turn' of 2 pi times the gear ratio",
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
        "torque-copied", "error", find_copied, everywhere=True,
        expected="a column of its own for the torque of each joint",
        do="check the logger, and the names of the columns under 'logs'",
    ),
    Check(
        WRONG_VELOCITY, "warning", find_wrong_velocity, expected="dq/dt",
        unless=("degrees", "time-unit", "dropouts", "jumps", "held-samples", "velocity-without-sign"),
    ),
    Check(ELASTIC, "warning", find_elastic, unless=("degrees", "time-unit", "frozen", "dropouts", "jumps")),
    Check("constant-torque", "warning", find_constant_torque, unless=("no-torques",), everywhere=True),
    Check("joint-at-rest", "info", find_rest, unless=("frozen",), everywhere=True),
]  # fmt: skip


def joint_kinds(joints: Iterable[Any]) -> list[str]:
    """Return the type of each joint for `check`: prismatic, revolute, or continuous if it has no position limits.

    joints: joints of an arm or of a model, with the attributes `joint_type` and `upper` (position limit, or None).
    """
    return ["continuous" if x.joint_type == "revolute" and x.upper is None else x.joint_type for x in joints]


class LogChecks:
    """Collector of the findings of all checks that need no robot, over the trajectories of n joints.

    Trajectories are added one at a time, so that only one of them has to be in memory.

    products: (2n, 2n) sum of the Gram matrices `velocity_products` of all trajectories, from which `velocity_agreement`
    computes the ratio and the correlation of dq/dt and qd.
    """

    def __init__(self, joints: Sequence[str], joint_types: Sequence[str]) -> None:
        self.products = np.zeros((2 * len(joints),) * 2)
        self._joints, self._kinds = joints, dict(zip(joints, joint_types, strict=True))
        self._results: dict[tuple[str, AnyCheck], list[tuple[Advice, str, Path | None]]] = {}
        self._count, self._has_velocities = 0, False
        self._fingerprints = Fingerprints()

    def add(self, trajectory: Trajectory) -> Trajectory:
        """Apply all checks that need no robot to a trajectory, and collect the findings.

        Return the trajectory for the later checks, which use a model of the robot. In it, velocities that are wrong for
        an unknown reason are replaced by dq/dt.
        """
        self._count += 1
        self._has_velocities |= "qd" in trajectory.mapping.quantities
        findings: list[tuple[AnyCheck, Advice]] = run_checks(CLOCK_CHECKS, trajectory, trajectory.accepted)
        findings += [(REPAIRED, Advice(message)) for message in trajectory.repairs]
        findings += [(REMARKED, Advice(message)) for message in trajectory.remarks]
        original = self._fingerprints.original(trajectory.fingerprint)
        self._fingerprints.add(trajectory.name, trajectory.fingerprint)
        if original:
            message = f"a quarter or more of its samples are also in trajectory {original}: omit one of both"
            findings.append((REPEATED, Advice(message)))
        for check, advice in findings:
            self._add(advice.message, check, advice, trajectory)
        products = velocity_products(trajectory)
        self.products += products
        factors, correlations = velocity_agreement(products)
        wrong = []
        for k, (joint, kind) in enumerate(self._kinds.items()):
            signals = JointSignals(trajectory, k, kind, self._joints, factors, correlations[:, k])
            for check, advice in run_checks(CHECKS, signals, trajectory.accepted):
                self._add(joint, check, advice, trajectory)
                if check.code == WRONG_VELOCITY and not (advice.joint or advice.keys):
                    wrong.append(k)
        return trajectory.differentiated(wrong) if wrong else trajectory

    def _add(self, group: str, check: AnyCheck, advice: Advice, trajectory: Trajectory) -> None:
        occurrence = advice, f"trajectory {trajectory.name}", trajectory.file
        self._results.setdefault((group, check), []).append(occurrence)

    def findings(self) -> Findings:
        """Return the findings of all trajectories: one error or note per fault, with the number of trajectories.

        An error names all joints with the same fault. Notes are separate for each joint.
        """
        summary = Findings()
        groups: dict[tuple[AnyCheck, str], list[str]] = {}
        for (group, check), occurrences in self._results.items():
            # A check with `everywhere` reports a fault only if it occurs in all trajectories. Example: a joint that
            # rests in some trajectories but moves in others is not reported.
            if not check.everywhere or len(occurrences) == self._count:
                advice, _, _ = occurrences[0]
                is_error = check.severity == "error" or advice.joint or advice.keys
                groups.setdefault((check, "" if is_error else group), []).append(group)
        codes = {check.code for check, _ in groups}
        for (check, _), names in groups.items():
            occurrences = self._results[names[0], check]
            advice, where, file = occurrences[0]
            # Samples that stay equal are searched with thresholds in rad and m. If a unit is wrong, they are reported
            # only after the user has corrected the unit.
            if check.code == "frozen" and advice.keys and "degrees" in codes:
                continue
            message = advice.message
            entries = {name: self._results[name, check][0][0].joint for name in names}
            if advice.is_guess:
                summary.guessed.update(names)
                if 2 * len(names) <= len(self._limited(names[0])):
                    # All joints of a type normally have one unit. If at most half of them have the fault, the guessed
                    # unit is uncertain: it is removed from the message (the text after the colon).
                    message, _, _ = message.partition(": ")
                    entries = {}
            if len(occurrences) > 1:
                message += f" (and in {counted(len(occurrences) - 1, 'more trajectory')})"
            if names[0] in self._joints:
                where += f", joint {', '.join(map(repr, names))}"
            keys = {**advice.keys, **(self._joint_keys(entries) if advice.joint and entries else {})}
            # Some recordings may not have the fault. For them, advised units, columns and sample rates may be wrong.
            # Other settings (dropouts, periods, sign bits) do not change recordings without the fault.
            is_partial = len(occurrences) < self._count and any(
                x in str(keys) for x in ("units", "columns", "rate")
            )
            summary.add(check, message, where, file, keys, is_partial)
        return summary

    def _kin(self, joint: str) -> list[str]:
        """Return the names of all joints of the same type as `joint`: all prismatic joints, or all others."""
        is_prismatic = self._kinds[joint] == "prismatic"
        return [x for x, kind in self._kinds.items() if (kind == "prismatic") == is_prismatic]

    def _limited(self, joint: str) -> list[str]:
        """Return the names of the joints of the same type as `joint`, without continuous joints.

        Only at joints with position limits do positions beyond two turns show a wrong unit.
        """
        return [x for x in self._kin(joint) if self._kinds[x] != "continuous"]

    def _joint_keys(self, entries: dict[str, Mapping[str, Any]]) -> dict[str, object]:
        """Return the settings for the group `logs` that correct one fault of several joints.

        If the fault is a wrong unit of most joints of one type (revolute or prismatic), the units are also set for the
        other joints of this type, unless a joint's ratio of dq/dt to qd, if logged, contradicts the units.

        entries: {joint: settings of this joint that correct the fault}.
        """
        first, *_ = entries
        units, kin = entries[first].get("units", {}), self._kin(first)
        ratio = SCALES.get(units.get("qd"), 1.0) / SCALES.get(units.get("q"), 1.0)
        factors, _ = velocity_agreement(self.products)
        is_shared = "units" in entries[first] and 2 * len(entries) > len(self._limited(first))
        for joint, factor in zip(self._joints, factors.tolist(), strict=True):
            is_unknown = np.isnan(factor) or not self._has_velocities
            if is_shared and joint in kin and (is_unknown or is_factor(factor, ratio)):
                entries.setdefault(joint, {"units": dict(units)})
        return joint_keys(entries, self._joints)


def check(
    trajectories: Iterable[Trajectory], joints: Sequence[str], joint_types: Sequence[str]
) -> list[Diagnostic]:
    """Apply the checks of logs that need no robot, and return their notes; the logs are not changed.

    Raises LogError with all findings of severity "error", e.g. positions in degrees without a declared unit, or a
    velocity that is constant while the position changes.
    """
    checks = LogChecks(joints, joint_types)
    for trajectory in trajectories:
        checks.add(trajectory)
    summary = checks.findings()
    collect(summary.errors)
    return summary.notes
