"""Report on the logs of a robot: ranges, noise and sample times, and the findings of all checks."""

from collections.abc import Iterable, Sequence

from spelgen.arm.configured_arm import Arm
from spelgen.errors import Diagnostic, LogError, Severity, collect
from spelgen.log_checks.check_servo_logs import ServoLogs
from spelgen.log_checks.check_torque_logs import (
    COUPLED,
    CURRENT,
    LOADS,
    WITHOUT_GRAVITY,
    WRONG_LINK,
    TorqueLogs,
)
from spelgen.log_checks.geometry_finding import WARNINGS
from spelgen.log_checks.limits_in_logs import AT_A_STOP
from spelgen.log_checks.report import LogReport, joint_report
from spelgen.log_checks.robot_checks import CHECKS
from spelgen.log_checks.statistics import Statistics, statistics
from spelgen.logs.checks import LogChecks, joint_kinds
from spelgen.logs.trajectory import Trajectory, require_joints
from spelgen.settings.log_mapping import LogMapping

ABOUT_ARM = {COUPLED, CURRENT, LOADS, WITHOUT_GRAVITY, WRONG_LINK, AT_A_STOP, *WARNINGS} | {
    x.code for x in CHECKS
}


def check_logs(
    logs: Trajectory | Iterable[Trajectory], arm: Arm, mapping: LogMapping | None = None
) -> LogReport:
    """Return the report on the logs of an arm; faults of the logs are not raised, but listed in its `errors`.

    Args:
        logs: one or several trajectories; an iterator is consumed once, one trajectory at a time.
        arm: the arm. Its input matrix converts logged torques to joint torques.
        mapping: mapping of the logs; None: the mapping in the arm's settings. Units that it declares are not checked,
            and checks whose codes it lists under `accept` are omitted.

    Raises:
        LogError: if there is no trajectory, for a trajectory with another number of joints, and for a trajectory
            without commands if the arm's settings contain 'input: position'.
    """
    joints = arm.chain.joint_names
    logs = [logs] if isinstance(logs, Trajectory) else logs
    checked: TorqueLogs | ServoLogs = TorqueLogs(arm, mapping or arm.settings.logs)
    if arm.settings.input == "position":
        checked = ServoLogs(arm)
    log_checks = LogChecks(joints, joint_kinds(arm.chain.coordinates))
    measured: list[Statistics] = []
    examples: list[Trajectory] = []
    # logs are read one trajectory at a time: an iterator of logs may be larger than memory
    for trajectory in logs:
        require_joints(trajectory, joints)
        checked.add(log_checks.add(trajectory))
        measured.append(statistics(trajectory))
        if len(examples) < 2:  # only two are kept: the HTML report plots two trajectories
            examples.append(trajectory)
    if not measured:
        raise LogError("no trajectory", expected="at least one")
    summary = log_checks.findings()
    coordinates = enumerate(arm.chain.coordinates)
    reports = [joint_report(k, coordinate, measured, log_checks.products) for k, coordinate in coordinates]
    completed, tables = checked.check(reports, summary)
    return LogReport(
        robot=arm.chain.name,
        trajectories=tuple(x.clock for x in measured),
        joints=completed,
        tables=tables,
        findings=_joined(summary.notes),
        errors=tuple(summary.errors),
        examples=tuple(examples),
    )


def _joined(notes: Iterable[Diagnostic]) -> tuple[Diagnostic, ...]:
    """Return the notes on logs; notes with the same text about several joints become one note that names the joints."""
    groups = dict[tuple[Severity, str, str, str], list[str]]()
    for note in notes:
        place, joint, name = note.where.partition("joint '")
        groups.setdefault((note.severity, note.code, place + joint, note.message), []).append(name)
    joined = []
    for (severity, code, place, message), names in groups.items():
        where = place + ", '".join(name for name in names if name)
        joined.append(Diagnostic(severity, code, where, None, message))
    return tuple(joined)


def require_sound_logs(
    logs: Sequence[Trajectory], arm: Arm, mapping: LogMapping | None = None
) -> list[Diagnostic]:
    """Check logs before a fit; return the findings that depend on the arm, such as a link with a wrong mass.

    All other findings are omitted, since the fit reports them itself. Raises LogError if the logs cannot be used for
    training. mapping: see `check_logs`.
    """
    # the command `spelgen logs` makes the same checks, so that training and the command reject the same logs
    report = check_logs(logs, arm, mapping)
    collect(report.errors)
    # Findings of checks that need no arm, and of the delay of torques, are omitted: the fit itself reports them.
    return [note for note in report.findings if note.code in ABOUT_ARM]
