"""Logs beside a robot: all that is measured, and what is odd about it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from spelgen.arm.arm import Coordinate
from spelgen.errors import Diagnostic, LogError, collect
from spelgen.identification.drive_hints import Coupling, DriveProblem, coupled_inputs, coupling, torque_delay
from spelgen.identification.drive_samples import DriveLog
from spelgen.log_checks.check_servo_logs import check_servo_logs
from spelgen.log_checks.gravity import GravityFit, StateSamples, fit_gravity, state_samples
from spelgen.log_checks.report import SEEN, JointReport, LogReport, range_fraction
from spelgen.log_checks.statistics import Statistics, common_step, statistics
from spelgen.logs.checks import Finding, findings, gap_diagnostics, summarised
from spelgen.logs.trajectory import QUANTITIES, Trajectory, require_joints, require_torques

if TYPE_CHECKING:
    from spelgen.loaded_arm import LoadedArm
    from spelgen.settings.log_mapping import LogMapping

EXAMPLES = 2  # trajectories that are drawn
BEYOND = 1e-3  # [rad, m, of a limit] a limit overrun by less is rounding
LOADED = 0.2  # deviation of the URDF's gravity torque, of the torque's: from here on it must be seen
UNSEEN = 0.3  # correlation of torque and gravity below which the one is not in the other
FACTORS = (0.2, 5.0)  # inertials in URDFs are often wrong, but not like this
CERTAIN = 0.9  # correlation from which on a wrong sign or unit is an error, where it is a warning before
IMPOSSIBLE = (0.1, 10.0)  # factors that only another unit has
BEYOND_DRIVES = 20.0  # times its effort limit no drive gives, in whatever unit


def check_logs(logs: Iterable[Trajectory], arm: LoadedArm, mapping: LogMapping | None = None) -> LogReport:
    """All about the logs of an arm, read once, one trajectory after another; nothing is repaired or raised.

    What keeps logs from being trained on is among the report's `errors`. mapping: by which they were read, that of
    the arm's settings unless given; a unit that it says of torques is believed. Logged torques go through the arm's
    input matrix to the joints'. Raises LogError without any trajectory, or with one of another number of joints, and
    where an arm's settings say 'input: position', without commands.
    """
    if arm.settings.input == "position":
        return check_servo_logs(logs, arm)
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
        notes += gap_diagnostics(trajectory)
        if len(examples) < EXAMPLES:
            examples.append(trajectory)
    if not measured:
        raise LogError("no trajectory", expected="at least one")
    about, errors = summarised(odd, joints, len(measured))
    notes += about
    gravity = fit_gravity(arm.arm, samples)
    reports = [_joint(k, *each, measured) for k, each in enumerate(zip(coordinates, gravity, strict=True))]
    mapping = mapping or arm.settings.logs
    for coordinate, report in zip(coordinates, reports, strict=True):
        largest = max(abs(report.low["tau"]), abs(report.high["tau"]))
        declared = mapping.unit("tau", coordinate.name) is not None
        wrong = torque_errors(coordinate, report.gravity, largest, declared=declared)
        errors += wrong
        notes += [*_limits(coordinate, report), *([] if wrong else _gravity(report))]
    if not errors:
        notes += _drives(arm, drives, mapping)
    return LogReport(
        robot=arm.arm.name,
        files=len({each.clock.file for each in measured} - {None}),
        trajectories=tuple(each.clock for each in measured),
        joints=tuple(reports),
        findings=tuple(notes),
        errors=tuple(errors),
        examples=tuple(examples),
    )


def _drives(arm: LoadedArm, log: DriveLog, mapping: LogMapping) -> list[Diagnostic]:
    """What the logs show of drives that the sidecar does not say."""
    samples, speeds = log.samples(), arm.actuation.drives().speeds
    if samples is None:
        return []
    problem = DriveProblem(arm.arm, samples, speeds)
    found = coupling(problem)
    if found is not None:
        return [_coupled(arm, found)]
    late = torque_delay(problem)
    if late is None:
        return []
    delay, left = mapping.torque_delay + late[0], late[1]
    when = "later" if late[0] > 0 else "earlier"
    message = (
        f"torques are logged {abs(late[0]) * 1e3:.3g} ms {when} than they act: so moved, least squares misses "
        f"{left:.0%} of what it missed (mean square); say 'torque_delay: {delay:.4g}' under 'logs' in the robot's YAML"
    )
    return [Diagnostic("warning", "torque-delay", "logs", None, message)]


def _coupled(arm: LoadedArm, found: Coupling) -> Diagnostic:
    """A coupling that the logs show, in the sidecar's words."""
    names = [c.name for c in arm.arm.coordinates]
    joints = [found.moved_by, found.joint]
    matrix = coupled_inputs(arm.actuation.drives(), found)[np.ix_(joints, joints)]
    said = f"couplings: [{{joints: {json.dumps([names[k] for k in joints])}, matrix: {matrix.round(6).tolist()}}}]"
    if found.logged_at == "motors" and arm.settings.torque == "joint":
        others = [name for k, name in enumerate(names) if k not in joints]
        gears = ", ".join(f"{json.dumps(name)}: {{gear: 1}}" for name in others)
        said += f", 'torque: motor' and joints: {{{gears}}}"
    moved, by = (repr(names[k]) for k in (found.joint, found.moved_by))
    message = (
        f"its motor turns with {by} too, {found.ratio:g} times as fast, and the logged torques are those of the "
        f"{found.logged_at}: least squares then misses {found.left:.0%} of what it missed of both torques (mean "
        f"square); say {said} in the robot's YAML"
    )
    return Diagnostic("warning", "coupled-motors", f"joint {moved}", None, message)


def _joint(
    index: int, coordinate: Coordinate, gravity: GravityFit, measured: Sequence[Statistics]
) -> JointReport:
    low = {name: min(float(each.low[name][index]) for each in measured) for name in QUANTITIES}
    high = {name: max(float(each.high[name][index]) for each in measured) for name in QUANTITIES}
    dense = [each.noise for each in measured if each.noise is not None]
    agreement = measured[0].agreement
    for each in measured[1:]:
        agreement = agreement + each.agreement
    return JointReport(
        name=coordinate.name,
        kind=coordinate.kind,
        low=low,
        high=high,
        range_fraction=range_fraction(coordinate, low["q"], high["q"]),
        noise={name: float(np.median([each[name][index] for each in dense])) for name in QUANTITIES}
        if dense
        else None,
        steps={name: common_step([each.steps[name][index] for each in measured]) for name in QUANTITIES},
        velocity_factor=agreement.factor(index) if agreement.xx[index] > 0 else None,
        velocity_correlation=agreement.correlation(index),
        gravity=gravity,
    )


def _limits(coordinate: Coordinate, joint: JointReport) -> list[Diagnostic]:
    """Where the logs go beyond what the URDF allows."""
    unit = {"revolute": ("rad", "rad/s", "Nm"), "prismatic": ("m", "m/s", "N")}[joint.kind]
    speed, torque = (max(abs(joint.low[x]), abs(joint.high[x])) for x in ("qd", "tau"))
    over = []
    lower, upper = (None, None) if coordinate.continuous else (coordinate.lower, coordinate.upper)
    if lower is not None and joint.low["q"] < lower - BEYOND:
        over.append(("position", f"q down to {joint.low['q']:.4g} {unit[0]}, the limit is {lower:.4g}"))
    if upper is not None and joint.high["q"] > upper + BEYOND:
        over.append(("position", f"q up to {joint.high['q']:.4g} {unit[0]}, the limit is {upper:.4g}"))
    for name, value, limit, unit_name in (
        ("velocity", speed, coordinate.velocity, unit[1]),
        ("effort", torque, coordinate.effort, unit[2]),
    ):
        if limit and value > limit * (1 + BEYOND):
            over.append((name, f"{name} up to {value:.4g} {unit_name}, the limit is {limit:.4g}"))
    where = f"joint {joint.name!r}"
    return [Diagnostic("warning", f"beyond-{name}-limit", where, None, what) for name, what in over]


def _gravity(joint: JointReport) -> list[Diagnostic]:
    """Where the torque does not move with gravity as the URDF says."""
    fit = joint.gravity
    if fit.factor is None or fit.correlation is None or (fit.relative_deviation or 0.0) < LOADED:
        return []
    where, (low, high) = f"joint {joint.name!r}", FACTORS
    if abs(fit.correlation) < UNSEEN:
        message = (
            f"tau does not move with gravity: their correlation is {fit.correlation:.2g}, while the URDF's "
            f"gravity torque varies {fit.relative_deviation:.2g} times as much as tau; is it compensated in the log?"
        )
        return [Diagnostic("warning", "torque-without-gravity", where, None, message)]
    if fit.correlation < -SEEN:
        message = f"tau moves against gravity: {fit.factor:.3g} times the URDF's; a sign of tau or q is wrong"
        return [Diagnostic("warning", "torque-against-gravity", where, None, message)]
    if fit.correlation > SEEN and not low < fit.factor < high:
        message = (
            f"tau moves with {fit.factor:.3g} times the URDF's gravity torque; check its unit and gain, or let the "
            f"gain be found: 'torque: motor', and 'gear: {1 / fit.factor:.3g}' with 'gain: trained' of this joint"
        )
        return [Diagnostic("warning", "torque-scale", where, None, message)]
    return []


def torque_errors(
    coordinate: Coordinate, fit: GravityFit, largest: float, *, declared: bool
) -> list[LogError]:
    """Why a joint's torques cannot be what they are said to be: certain where the URDF's gravity is in them.

    largest: that was logged [Nm, N]. declared: the mapping says the unit of the torques, so their size is believed.
    """
    where = f"joint {coordinate.name!r}, tau"
    do = "say 'units: {tau: ...}' or a 'gain' under 'logs' in the robot's YAML; 'Nm' says that they are right"
    seen = (fit.relative_deviation or 0.0) >= LOADED if fit.factor is not None else False
    if seen and fit.factor is not None and fit.correlation is not None:
        if fit.correlation < -CERTAIN:
            got = f"torques that move against gravity, {fit.factor:.3g} times the URDF's"
            return [LogError(
                got, element=where, expected="the URDF's sense",
                do="say 'sign: -1' or a negative 'gain' of the joint under 'logs', or the gravity of this mounting",
            )]  # fmt: skip
        low, high = IMPOSSIBLE
        if fit.correlation > CERTAIN and not declared and not low < fit.factor < high:
            got = f"torques that move with {fit.factor:.3g} times the URDF's gravity torque"
            return [LogError(got, element=where, expected="Nm or N at the joint", do=do)]
    limit = coordinate.effort or 0.0
    if not declared and limit > 0 and largest > BEYOND_DRIVES * limit:
        got = f"up to {largest:.4g}, {largest / limit:.3g} times what the drive can give"
        return [LogError(got, element=where, expected="Nm or N at the joint", do=do)]
    return []


def require_possible_torques(
    logs: Sequence[Trajectory], arm: LoadedArm, mapping: LogMapping | None = None
) -> None:
    """Raise LogError where the torques of logs cannot be an arm's, before anything is fitted to them."""
    require_torques(logs)
    inputs = arm.actuation.matrix()
    fits = fit_gravity(arm.arm, [state_samples(trajectory, inputs) for trajectory in logs])
    collect([
        error
        for k, (coordinate, fit) in enumerate(zip(arm.arm.coordinates, fits, strict=True))
        for error in torque_errors(
            coordinate, fit, max(float(np.abs(x.tau[:, k]).max()) for x in logs),
            declared=(mapping or arm.settings.logs).unit("tau", coordinate.name) is not None,
        )
    ])  # fmt: skip
