"""Report all that logs show beside a robot, and what is odd about it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from spelgen.arm.arm import Coordinate
from spelgen.errors import Diagnostic, LogError, SpelgenError, collect
from spelgen.identification.drive_hints import drive_hints
from spelgen.identification.drive_samples import DriveLog
from spelgen.log_checks.check_servo_logs import check_servo_logs
from spelgen.log_checks.gravity import GravityFit, StateSamples, fit_gravity, state_samples
from spelgen.log_checks.report import JointReport, LogReport, range_fraction
from spelgen.log_checks.robot_checks import CHECKS, JointEvidence
from spelgen.log_checks.statistics import Statistics, common_step, statistics
from spelgen.logs.checks import Finding, clock_diagnostics, findings, run_checks, summarised
from spelgen.logs.trajectory import QUANTITIES, Trajectory, require_joints, require_torques

if TYPE_CHECKING:
    from spelgen.loaded_arm import LoadedArm
    from spelgen.settings.log_mapping import LogMapping

EXAMPLES = 2  # trajectories that are drawn


def check_logs(logs: Iterable[Trajectory], arm: LoadedArm, mapping: LogMapping | None = None) -> LogReport:
    """Report all about the logs of an arm, read once, one trajectory after another; nothing is repaired or raised.

    The report's `errors` prevent training. mapping: that of the logs, by default from the arm's settings; a unit that
    it declares for torques is not checked. The arm's input matrix converts logged torques to those of the joints.
    Raises LogError without any trajectory, or with one of another number of joints, and
    where an arm's settings say 'input: position', without commands.
    """
    if arm.settings.input == "position":
        return check_servo_logs(logs, arm)
    mapping = mapping or arm.settings.logs
    coordinates, inputs = arm.arm.coordinates, arm.actuation.matrix()
    joints, kinds = [c.name for c in coordinates], [c.kind for c in coordinates]
    drives = DriveLog(inputs)
    measured: list[Statistics] = []
    samples: list[StateSamples] = []
    examples: list[Trajectory] = []
    notes: list[Diagnostic] = []
    odd: list[Finding] = []
    for trajectory in logs:
        require_joints(trajectory, joints)
        require_torques([trajectory])
        measured.append(statistics(trajectory))
        samples.append(state_samples(trajectory, inputs))
        drives.add(trajectory)
        odd += findings(trajectory, joints, kinds, measured[-1].agreement)
        notes += clock_diagnostics(trajectory)
        if len(examples) < EXAMPLES:
            examples.append(trajectory)
    if not measured:
        raise LogError("no trajectory", expected="at least one")
    summaries, errors = summarised(odd, joints, len(measured))
    notes += summaries
    reports = []
    for index, (coordinate, gravity) in enumerate(
        zip(coordinates, fit_gravity(arm.arm, samples), strict=True)
    ):
        report = _joint_report(index, coordinate, gravity, measured)
        reports.append(report)
        evidence = _evidence(coordinate, report.low, report.high, gravity, mapping)
        robot_notes, robot_errors = _against_robot(evidence)
        notes += robot_notes
        errors += robot_errors
    # of torques that are wrong, hints about drives would be wrong too
    if not errors:
        notes += drive_hints(arm, drives, mapping)
    return LogReport(
        robot=arm.arm.name,
        files=len({x.clock.file for x in measured} - {None}),
        trajectories=tuple(x.clock for x in measured),
        joints=tuple(reports),
        findings=tuple(notes),
        errors=tuple(errors),
        examples=tuple(examples),
    )


def require_possible_torques(
    logs: Sequence[Trajectory], arm: LoadedArm, mapping: LogMapping | None = None
) -> None:
    """Raise LogError where the torques of logs cannot be an arm's, before anything is fitted to them."""
    require_torques(logs)
    mapping = mapping or arm.settings.logs
    inputs = arm.actuation.matrix()
    fits = fit_gravity(arm.arm, [state_samples(trajectory, inputs) for trajectory in logs])
    errors: list[SpelgenError] = []
    for index, (coordinate, gravity) in enumerate(zip(arm.arm.coordinates, fits, strict=True)):
        low, high = {}, {}
        for name in QUANTITIES:
            low[name] = min(float(getattr(x, name)[:, index].min()) for x in logs)
            high[name] = max(float(getattr(x, name)[:, index].max()) for x in logs)
        errors += _against_robot(_evidence(coordinate, low, high, gravity, mapping))[1]
    collect(errors)


def _evidence(
    coordinate: Coordinate,
    low: dict[str, float],
    high: dict[str, float],
    gravity: GravityFit,
    mapping: LogMapping,
) -> JointEvidence:
    declared = mapping.unit("tau", coordinate.name) is not None
    return JointEvidence(coordinate, low, high, gravity, declared)


def _against_robot(evidence: JointEvidence) -> tuple[list[Diagnostic], list[LogError]]:
    """Return what the checks against the robot find of one joint: notes, and why it cannot be trained on."""
    notes: list[Diagnostic] = []
    errors: list[LogError] = []
    where = f"joint {evidence.coordinate.name!r}"
    for check, message in run_checks(CHECKS, evidence):
        if check.severity == "error":
            errors.append(check.error(message, f"{where}, tau"))
        else:
            notes.append(check.diagnostic(message, where))
    return notes, errors


def _joint_report(
    index: int, coordinate: Coordinate, gravity: GravityFit, measured: Sequence[Statistics]
) -> JointReport:
    """Put together what all trajectories show of one joint."""
    low, high = {}, {}
    noise: dict[str, float] = {}
    steps: dict[str, float | None] = {}
    noisy = [x.noise for x in measured if x.noise is not None]
    for name in QUANTITIES:
        low[name] = min(float(x.low[name][index]) for x in measured)
        high[name] = max(float(x.high[name][index]) for x in measured)
        steps[name] = common_step([x.steps[name][index] for x in measured])
        if noisy:
            noise[name] = float(np.median([x[name][index] for x in noisy]))
    agreement = measured[0].agreement
    for other in measured[1:]:
        agreement += other.agreement
    return JointReport(
        name=coordinate.name,
        kind=coordinate.kind,
        low=low,
        high=high,
        range_fraction=range_fraction(coordinate, low["q"], high["q"]),
        noise=noise or None,
        steps=steps,
        velocity_factor=agreement.factor(index) if agreement.xx[index] > 0 else None,
        velocity_correlation=agreement.correlation(index),
        gravity=gravity,
    )
