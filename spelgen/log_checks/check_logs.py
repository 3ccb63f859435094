"""Report all that logs show beside a robot, and what is odd about it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from spelgen.dynamics.regressor import body_chain
from spelgen.errors import Diagnostic, LogError, collect
from spelgen.identification.drive_hints import Coupling, drive_problem, find_wrong_torques
from spelgen.identification.drive_samples import DriveLog
from spelgen.identification.torque_delay import delay_of
from spelgen.listing import Listing, number
from spelgen.log_checks.check_servo_logs import ServoLogs
from spelgen.log_checks.gravity import find_opposed_inertia, fit_gravity, joined, state_samples
from spelgen.log_checks.report import JointReport, LogReport, joint_report, percent, signal_tables
from spelgen.log_checks.robot_checks import CHECKS, SENSE, JointEvidence
from spelgen.log_checks.statistics import Statistics, statistics
from spelgen.log_checks.tuning import TUNING
from spelgen.logs.checks import Findings, LogChecks, run_checks
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.tables import UNIT_CODES
from spelgen.logs.trajectory import QUANTITIES, Trajectory, require_joints, require_torques

if TYPE_CHECKING:
    from spelgen.arm.configured_arm import ConfiguredArm
    from spelgen.settings.log_mapping import LogMapping

ORDER = replace(
    SENSE, code="torque-order", expected="its own", do="change the names of the columns under 'logs'"
)
COUPLED = "coupled-motors"
WRONG_TORQUES = {"torque-sense": SENSE, "torque-order": ORDER}
ABOUT_ARM = {check.code for check in CHECKS} | {COUPLED}


def check_logs(
    logs: Iterable[Trajectory], arm: ConfiguredArm, mapping: LogMapping | None = None
) -> LogReport:
    """Report all about the logs of an arm, read once, one trajectory after another; nothing is repaired or raised.

    The report's `errors` prevent training. mapping: that of the logs, by default from the arm's settings; units that
    it declares and errors that it accepts are not checked. The arm's input matrix converts logged torques to those of
    the joints. Raises LogError without any trajectory, or with one of another number of joints, and
    where an arm's settings say 'input: position', without commands.
    """
    joints = arm.arm.joint_names
    checked: TorqueLogs | ServoLogs = TorqueLogs(arm, mapping or arm.settings.logs)
    if arm.settings.input == "position":
        checked = ServoLogs(arm)
    types = [
        "continuous" if x.kind == "revolute" and x.limits is None else x.kind for x in arm.arm.coordinates
    ]
    log_checks = LogChecks(joints, types)
    measured: list[Statistics] = []
    examples: list[Trajectory] = []
    # one after another: a stream of logs may be larger than memory
    for trajectory in logs:
        require_joints(trajectory, joints)
        checked.add(trajectory)
        log_checks.add(trajectory)
        measured.append(statistics(trajectory))
        if len(examples) < TUNING.examples:
            examples.append(trajectory)
    if not measured:
        raise LogError("no trajectory", expected="at least one")
    summary = log_checks.findings()
    reports = []
    for index, coordinate in enumerate(arm.arm.coordinates):
        reports.append(joint_report(index, coordinate, measured, log_checks.products))
    completed, tables = checked.check(reports, summary)
    return LogReport(
        robot=arm.arm.name,
        trajectories=tuple(x.clock for x in measured),
        joints=completed,
        tables=tables,
        findings=tuple(summary.notes),
        errors=tuple(summary.errors),
        examples=tuple(examples),
    )


def require_sound_logs(
    logs: Sequence[Trajectory], arm: ConfiguredArm, mapping: LogMapping | None = None
) -> list[Diagnostic]:
    """Return what `check_logs` finds of logs beside their arm; raise LogError where they cannot be trained on."""
    # the same checks as the command, so that a fit refuses what `spelgen logs` refuses
    report = check_logs(logs, arm, mapping)
    collect(report.errors)
    # a fit itself tells what logs show without the arm, and finds the delay of torques
    return [note for note in report.findings if note.code in ABOUT_ARM]


class TorqueLogs:
    """Check logs of torques beside their arm, from samples that are kept while the logs go by."""

    def __init__(self, arm: ConfiguredArm, mapping: LogMapping) -> None:
        self._arm, self._mapping, self._drives = arm, mapping, arm.actuation.drives()
        self._samples: list[np.ndarray] = []
        self._moving = DriveLog(arm.arm.joint_types, self._drives, Preprocessing())
        self._declared: list[set[str]] = []

    def add(self, trajectory: Trajectory) -> None:
        """Take in a trajectory. Raises LogError without torques."""
        require_torques([trajectory])
        self._samples.append(state_samples(trajectory, self._drives.inputs))
        self._moving.add(trajectory)
        self._declared.append(set(trajectory.accepted))

    def check(
        self, reports: Sequence[JointReport], summary: Findings
    ) -> tuple[list[JointReport], tuple[Listing, ...]]:
        """Return the reports with what gravity explains, and tables; add what is odd to the summary."""
        # what files declare by themselves holds where all of them do
        accepted = set(self._mapping.accept) | set.intersection(*self._declared)
        motion = joined(self._samples)
        completed = []
        fits = fit_gravity(self._arm.arm, motion)
        for coordinate, report, gravity in zip(self._arm.arm.coordinates, reports, fits, strict=True):
            completed.append(replace(report, gravity=gravity))
            passed = accepted
            # a unit that somebody wrote down is taken as right
            if self._mapping.unit("tau", coordinate.name) is not None:
                passed = accepted.union(UNIT_CODES)
            where = f"joint {coordinate.name!r}"
            for check, message in run_checks(CHECKS, JointEvidence(coordinate, completed[-1]), passed):
                summary.add(check, message, f"{where}, tau" if check.severity == "error" else where)
        # beside wrong velocities friction is wrong too, and of wrong torques hints about drives would be wrong
        if not any(note.code == "velocity-is-no-derivative" for note in summary.notes):
            self._check_together(motion, accepted, summary)
        return completed, (*signal_tables(completed, QUANTITIES), _physics_table(completed))

    def _check_together(self, motion: np.ndarray, accepted: set[str], summary: Findings) -> None:
        """Add what is wrong with the torques of all joints together, or else a coupling of motors, or else a delay.

        motion: samples (4, S, n), see `state_samples`.
        """
        arm, joints, drives = self._arm.arm, self._arm.arm.joint_names, self._drives
        if not summary.errors and SENSE.code not in accepted:
            opposed = find_opposed_inertia(arm, motion, drives.speeds)
            if opposed is not None:
                summary.add(SENSE, opposed, "tau")
        moving = self._moving.samples()
        if moving is None or summary.errors:
            return
        problem = drive_problem(body_chain(arm), drives, moving)
        wrong = find_wrong_torques(problem, joints)
        if wrong is not None and wrong.code not in accepted:
            summary.add(WRONG_TORQUES[wrong.code], wrong.got, f"joint {joints[wrong.joint]!r}, tau")
            return
        late = delay_of(problem)
        if late.coupling is not None:
            summary.notes.append(_coupling_hint(self._arm, *late.coupling))
        else:
            summary.notes.extend(late.notes)


def _coupling_hint(arm: ConfiguredArm, coupling: Coupling, remaining: float) -> Diagnostic:
    """Return a coupling that the logs show, in the sidecar's words."""
    names = arm.arm.joint_names
    pair = [coupling.moved_by, coupling.joint]
    matrix = np.array([[1.0, coupling.ratio], [0.0, 1.0]]) * np.diag(arm.actuation.matrix())[pair]
    joints = json.dumps([names[k] for k in pair])
    setting = f"couplings: [{{joints: {joints}, matrix: {matrix.round(6).tolist()}}}]"
    if coupling.logged_at == "motors" and arm.settings.torque == "joint":
        uncoupled = [name for k, name in enumerate(names) if k not in pair]
        gears = ", ".join(f"{json.dumps(name)}: {{gear: 1}}" for name in uncoupled)
        setting += f", 'torque: motor' and joints: {{{gears}}}"
    message = (
        f"its motor turns with {names[coupling.moved_by]!r} too, {coupling.ratio:g} times as fast, and the logged "
        f"torques are those of the {coupling.logged_at}: least squares then misses {remaining:.0%} of what it missed "
        f"of both torques (mean square); say {setting} in the robot's YAML"
    )
    return Diagnostic("warning", COUPLED, f"joint {names[coupling.joint]!r}", None, message)


def _physics_table(joints: Sequence[JointReport]) -> Listing:
    head = ("joint", "dq/dt : qd", "agree", "gravity in tau", "x URDF")
    rows = []
    for joint in joints:
        fit = joint.gravity
        # beside a low correlation the factor means nothing
        is_seen = abs(fit.correlation or 0) > TUNING.seen
        velocity = number(joint.velocity_factor), number(joint.velocity_correlation)
        rows.append((joint.name, *velocity, percent(fit.explained), number(fit.factor if is_seen else None)))
    note = (
        "dq/dt : qd and its correlation are 1 where qd is the derivative of q; gravity in tau: part of tau's "
        "variance that gravity explains, beside friction and acceleration; x URDF: ratio to the URDF's gravity "
        "torque."
    )
    return Listing("Physics", head, tuple(rows), note)
