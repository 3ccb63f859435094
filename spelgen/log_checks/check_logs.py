"""Report all that logs show beside a robot, and what is odd about it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import reduce
from operator import add
from typing import TYPE_CHECKING

import numpy as np

from spelgen.arm.arm import Coordinate
from spelgen.dynamics.rigid_bodies import body_chain
from spelgen.errors import Diagnostic, LogError, collect
from spelgen.identification.drive_hints import Coupling, drive_problem, find_wrong_torques
from spelgen.identification.drive_samples import DriveLog, DriveSamples
from spelgen.identification.torque_delay import delay_of
from spelgen.log_checks.check_servo_logs import check_servo_logs
from spelgen.log_checks.gravity import (
    GravityFit,
    find_opposed_inertia,
    fit_gravity,
    joined,
    state_samples,
)
from spelgen.log_checks.report import TUNING, JointReport, LogReport, range_fraction
from spelgen.log_checks.robot_checks import CHECKS, JointEvidence
from spelgen.log_checks.statistics import Statistics, joint_statistics, statistics
from spelgen.logs.checks import Finding, Findings, clock_diagnostics, findings, once, run_checks, summarised
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.tables import UNIT_CODES
from spelgen.logs.trajectory import Trajectory, require_joints, require_torques

if TYPE_CHECKING:
    from spelgen.loaded_arm import LoadedArm
    from spelgen.settings.log_mapping import LogMapping

SENSE = next(check for check in CHECKS if check.code == "torque-sense")
ORDER = replace(
    SENSE, code="torque-order", expected="its own", do="change the names of the columns under 'logs'"
)
COUPLED = "coupled-motors"
WRONG_TORQUES = {"torque-sense": SENSE, "torque-order": ORDER}
ABOUT_ARM = {check.code for check in CHECKS} | {COUPLED}


def check_logs(logs: Iterable[Trajectory], arm: LoadedArm, mapping: LogMapping | None = None) -> LogReport:
    """Report all about the logs of an arm, read once, one trajectory after another; nothing is repaired or raised.

    The report's `errors` prevent training. mapping: that of the logs, by default from the arm's settings; units that
    it declares and errors that it accepts are not checked. The arm's input matrix converts logged torques to those of
    the joints. Raises LogError without any trajectory, or with one of another number of joints, and
    where an arm's settings say 'input: position', without commands.
    """
    if arm.settings.input == "position":
        return check_servo_logs(logs, arm)
    mapping = mapping or arm.settings.logs
    joints, kinds, drives = arm.arm.joint_names, arm.arm.joint_types, arm.actuation.drives()
    moving = DriveLog(kinds, drives, Preprocessing())
    measured: list[Statistics] = []
    samples: list[np.ndarray] = []
    examples: list[Trajectory] = []
    notes: list[Diagnostic] = []
    odd: list[Finding] = []
    declared_codes: list[set[str]] = []
    # one after another: a stream of logs may be larger than memory
    for trajectory in logs:
        require_joints(trajectory, joints)
        require_torques([trajectory])
        measured.append(statistics(trajectory))
        samples.append(state_samples(trajectory, drives.inputs))
        moving.add(trajectory)
        declared_codes.append(set(trajectory.accepted))
        odd += findings(trajectory, joints, kinds, measured[-1].agreement)
        notes += clock_diagnostics(trajectory)
        if len(examples) < TUNING.examples:
            examples.append(trajectory)
    if not measured:
        raise LogError("no trajectory", expected="at least one")
    # what files declare by themselves holds where all of them do
    accepted = set(mapping.accept) | set.intersection(*declared_codes)
    notes = once(notes)
    summary = summarised(odd, joints, len(measured))
    motion = joined(samples)
    reports = []
    for index, (coordinate, gravity) in enumerate(
        zip(arm.arm.coordinates, fit_gravity(arm.arm, motion), strict=True)
    ):
        report = _joint_report(index, coordinate, gravity, measured)
        reports.append(report)
        evidence = JointEvidence(coordinate, report.low, report.high, report.steps, gravity)
        passed = accepted
        # a unit that somebody wrote down is taken as right
        if mapping.unit("tau", coordinate.name) is not None:
            passed = accepted.union(UNIT_CODES)
        where = f"joint {coordinate.name!r}"
        for check, message in run_checks(CHECKS, evidence, passed):
            place = f"{where}, tau" if check.severity == "error" else where
            summary.add(check, message, place)
    # beside wrong velocities friction is wrong too, and of wrong torques hints about drives would be wrong
    if not any(note.code == "velocity-is-no-derivative" for note in summary.notes):
        _check_all_torques(arm, motion, moving.samples(), accepted, summary)
    return LogReport(
        robot=arm.arm.name,
        files=len({x.clock.file for x in measured} - {None}),
        trajectories=tuple(x.clock for x in measured),
        joints=tuple(reports),
        findings=(*notes, *summary.notes),
        errors=tuple(summary.errors),
        examples=tuple(examples),
    )


def require_sound_logs(
    logs: Sequence[Trajectory], arm: LoadedArm, mapping: LogMapping | None = None
) -> list[Diagnostic]:
    """Return what `check_logs` finds of logs beside their arm; raise LogError where they cannot be trained on."""
    # the same checks as the command, so that a fit refuses what `spelgen logs` refuses
    report = check_logs(logs, arm, mapping)
    collect(report.errors)
    # a fit itself tells what logs show without the arm, and finds the delay of torques
    return [note for note in report.findings if note.code in ABOUT_ARM]


def _check_all_torques(
    arm: LoadedArm, motion: np.ndarray, moving: DriveSamples | None, accepted: set[str], summary: Findings
) -> None:
    """Add what is wrong with the torques of all joints together, or else a coupling of motors, or else a delay.

    motion: samples (4, S, n), see `state_samples`.
    """
    joints, drives = arm.arm.joint_names, arm.actuation.drives()
    if not summary.errors and SENSE.code not in accepted:
        opposed = find_opposed_inertia(arm.arm, motion, drives.speeds)
        if opposed is not None:
            summary.add(SENSE, opposed, "tau")
    if moving is None or summary.errors:
        return
    chain = body_chain(arm.arm)
    problem = drive_problem(chain, drives, moving)
    if problem is not None:
        wrong = find_wrong_torques(problem, joints)
        if wrong is not None and wrong.code not in accepted:
            summary.add(WRONG_TORQUES[wrong.code], wrong.got, f"joint {joints[wrong.joint]!r}, tau")
            return
    late = delay_of(moving, problem, arm.arm.joint_types, drives, chain)
    if late.coupling is not None:
        summary.notes.append(_coupling_hint(arm, *late.coupling))
    else:
        summary.notes.extend(late.notes)


def _coupling_hint(arm: LoadedArm, coupling: Coupling, remaining: float) -> Diagnostic:
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


def _joint_report(
    index: int, coordinate: Coordinate, gravity: GravityFit, measured: Sequence[Statistics]
) -> JointReport:
    """Put together what all trajectories show of one joint."""
    signals = joint_statistics(index, measured)
    agreement = reduce(add, [x.agreement for x in measured])
    return JointReport(
        name=coordinate.name,
        kind=coordinate.kind,
        low=signals.low,
        high=signals.high,
        range_fraction=range_fraction(coordinate, signals.low["q"], signals.high["q"]),
        noise=signals.noise or None,
        steps=signals.steps,
        velocity_factor=agreement.factor(index) if agreement.xx[index] > 0 else None,
        velocity_correlation=agreement.correlation(index),
        gravity=gravity,
    )
