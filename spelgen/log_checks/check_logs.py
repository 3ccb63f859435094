"""Report of the content of the logs of a robot, with findings about them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from spelgen.errors import Diagnostic, LogError, collect
from spelgen.log_checks.check_servo_logs import ServoLogs
from spelgen.log_checks.check_torque_logs import COUPLED, CURRENT, WRONG_LINK, TorqueLogs
from spelgen.log_checks.remedies import GEOMETRY_CODES
from spelgen.log_checks.report import LogReport, joint_report
from spelgen.log_checks.robot_checks import CHECKS
from spelgen.log_checks.statistics import Statistics, statistics
from spelgen.logs.checks import LogChecks
from spelgen.logs.trajectory import Trajectory, require_joints

if TYPE_CHECKING:
    from spelgen.arm.configured_arm import Arm
    from spelgen.settings.log_mapping import LogMapping

ABOUT_ARM = {check.code for check in CHECKS} | {COUPLED, CURRENT, WRONG_LINK, *GEOMETRY_CODES}


def check_logs(logs: Iterable[Trajectory], arm: Arm, mapping: LogMapping | None = None) -> LogReport:
    """Return the report about the logs of an arm, which are read once. Faults of the logs are reported, not raised.

    The report's `errors` prevent training. mapping: of the logs, by default from the arm's settings; units that
    it declares and errors that it accepts are not checked. The arm's input matrix converts logged torques to joint
    torques. Raises LogError without any trajectory, for another number of joints, and without commands if the
    arm's settings have 'input: position'.
    """
    joints = arm.chain.joint_names
    checked: TorqueLogs | ServoLogs = TorqueLogs(arm, mapping or arm.settings.logs)
    if arm.settings.input == "position":
        checked = ServoLogs(arm)
    types = [
        "continuous" if x.joint_type == "revolute" and x.limits is None else x.joint_type
        for x in arm.chain.coordinates
    ]
    log_checks = LogChecks(joints, types)
    measured: list[Statistics] = []
    examples: list[Trajectory] = []
    # one trajectory at a time: an iterator of logs may be larger than memory
    for trajectory in logs:
        require_joints(trajectory, joints)
        checked.add(trajectory)
        log_checks.add(trajectory)
        measured.append(statistics(trajectory))
        if len(examples) < 2:  # which a page draws
            examples.append(trajectory)
    if not measured:
        raise LogError("no trajectory", expected="at least one")
    summary = log_checks.findings()
    reports = []
    for index, coordinate in enumerate(arm.chain.coordinates):
        reports.append(joint_report(index, coordinate, measured, log_checks.products))
    completed, tables = checked.check(reports, summary)
    return LogReport(
        robot=arm.chain.name,
        trajectories=tuple(x.clock for x in measured),
        joints=completed,
        tables=tables,
        findings=tuple(summary.notes),
        errors=tuple(summary.errors),
        examples=tuple(examples),
    )


def require_sound_logs(
    logs: Sequence[Trajectory], arm: Arm, mapping: LogMapping | None = None
) -> list[Diagnostic]:
    """Return the findings of `check_logs` about an arm and its logs; raise LogError if they cannot be trained on."""
    # the same checks as the command: a fit and `spelgen logs` refuse the same logs
    report = check_logs(logs, arm, mapping)
    collect(report.errors)
    # a fit itself reports checks that need no arm, and finds the delay of torques
    return [note for note in report.findings if note.code in ABOUT_ARM]
