"""Check logs of commanded positions beside a robot: what they hold, how joints follow, and what is odd about it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from spelgen.errors import Diagnostic, LogError
from spelgen.log_checks.following import DELAYS, NO_DELAY, TUNING, Following, measure_following
from spelgen.log_checks.gravity import GravityFit
from spelgen.log_checks.report import range_fraction
from spelgen.log_checks.robot_checks import POSITION_CHECKS, JointEvidence
from spelgen.log_checks.servo_report import ServoJointReport, ServoLogReport
from spelgen.log_checks.statistics import Clock, JointStatistics, joint_statistics, statistics
from spelgen.logs.checks import (
    DEGREES,
    Finding,
    clock_diagnostics,
    findings,
    is_factor,
    once,
    run_checks,
    summarised,
)
from spelgen.logs.trajectory import Trajectory, require_commands, require_joints
from spelgen.settings.tuning.log_checks import LogCheckTuning

if TYPE_CHECKING:
    from spelgen.loaded_arm import LoadedArm

CHECKS = LogCheckTuning()
FOLLOWS = CHECKS.agreement


def check_servo_logs(logs: Iterable[Trajectory], arm: LoadedArm) -> ServoLogReport:
    """Report all about logs of commanded positions; nothing is repaired or raised but what `check_logs` raises."""
    coordinates = arm.arm.coordinates
    joints, kinds = arm.arm.joint_names, arm.arm.joint_types
    logs = list(logs)
    if not logs:
        raise LogError("no trajectory", expected="at least one")
    notes: list[Diagnostic] = []
    odd: list[Finding] = []
    for log in logs:
        require_joints(log, joints)
        require_commands(log)
        odd += findings(log, joints, kinds)
        notes += clock_diagnostics(log)
    notes = once(notes)
    summary = summarised(odd, joints, len(logs))
    following = measure_following(logs, _saturation(arm))
    measured = list(map(statistics, logs))
    clocks = [x.clock for x in measured]
    reports = []
    for k, coordinate in enumerate(coordinates):
        signals = joint_statistics(k, measured)
        report = _joint(arm, k, signals, following)
        reports.append(report)
        wrong = _wrong_command(k, joints, following)
        if wrong is None:
            # some loggers write measured positions in place of commands
            copied = all(np.array_equal(log.q[:, k], require_commands(log)[:, k]) for log in logs)
            summary.notes.extend(_odd_command(k, report, following, copied=copied))
            evidence = JointEvidence(coordinate, signals.low, signals.high, signals.steps, GravityFit())
            for check, message in run_checks(POSITION_CHECKS, evidence):
                summary.add(check, message, f"joint {coordinate.name!r}")
        else:
            summary.errors.append(wrong)
    summary.notes.extend(_sparse(clocks))
    return ServoLogReport(
        robot=arm.arm.name,
        files=len({clock.file for clock in clocks} - {None}),
        trajectories=tuple(clocks),
        joints=(),
        findings=(*notes, *summary.notes),
        errors=tuple(summary.errors),
        examples=tuple(logs[: CHECKS.examples]),
        servos=tuple(reports),
    )


def _saturation(arm: LoadedArm) -> np.ndarray:
    """Return distances from the command (n,) at which servos give all they can; infinite where that is not known."""
    distances = np.full(len(arm.arm.coordinates), np.inf)
    for k, coordinate in enumerate(arm.arm.coordinates):
        kp = arm.settings.joint(coordinate.name).kp
        if coordinate.effort and kp:
            distances[k] = coordinate.effort / kp
    return distances


def _joint(arm: LoadedArm, k: int, signals: JointStatistics, following: Following) -> ServoJointReport:
    coordinate = arm.arm.coordinates[k]
    delay, lag = NO_DELAY, None
    if following.moves[k]:
        delay = following.best_delay(k, k)
        lag = float(DELAYS[delay])
    steady_state_error, saturated = None, None
    if len(following.steady_state_errors[k]):
        # nine tenths: where an arm leans on something it may be anywhere
        steady_state_error = float(np.quantile(np.abs(following.steady_state_errors[k]), 0.9))
    if arm.settings.joint(coordinate.name).kp is not None:
        saturated = float(following.saturated[k])
    return ServoJointReport(
        name=coordinate.name,
        kind=coordinate.kind,
        q=(signals.low["q"], signals.high["q"]),
        u=(signals.low["u"], signals.high["u"]),
        range_fraction=range_fraction(coordinate, signals.low["q"], signals.high["q"]),
        noise=signals.noise.get("q"),
        steps=signals.steps,
        lag=lag,
        tracking_rms=float(following.tracking_rms[delay, k]),
        steady_state_error=steady_state_error,
        saturated=saturated,
    )


def _wrong_command(k: int, joints: Sequence[str], following: Following) -> LogError | None:
    """Return why a command cannot be that of its joint, None where it can."""
    # what does not move follows nothing, and proves nothing wrong
    if not following.moves[k]:
        return None
    # judged at the delay at which the two are most alike: a slow servo is no wrong one
    where, delay = f"joint {joints[k]!r}", following.best_delay(k, k)
    correlation, gain = float(following.correlation[delay, k, k]), float(following.gain[delay, k, k])
    # a servo follows its command to a fifth, unless one of the two is in degrees
    in_degrees = is_factor(gain, DEGREES) or is_factor(gain, 1 / DEGREES)
    if correlation > FOLLOWS and in_degrees:
        got = f"positions that move {gain:.3g} times as far as commands (180/pi is 57.3)"
        do = "write 'units' of q and u under 'logs' in the robot's YAML"
        return LogError(got, element=where, expected="both in radians", do=do)
    if correlation < -FOLLOWS:
        got = f"positions that move against commands (correlation {correlation:.2g})"
        return LogError(got, element=where, expected="one sense", do="check the signs of q and u")
    # swapped columns: another joint follows this command
    if correlation < TUNING.ignores:
        for other, name in enumerate(joints):
            delay = following.best_delay(k, other)
            if other != k and following.correlation[delay, k, other] > FOLLOWS:
                got = f"a command that joint {name!r} follows, and this one does not"
                do = "check the names of the columns"
                return LogError(got, element=where, expected="its own command", do=do)
    return None


def _odd_command(
    k: int, report: ServoJointReport, following: Following, *, copied: bool
) -> Iterator[Diagnostic]:
    """Yield what is odd about a joint's command; copied: it is the position itself."""
    delay = following.best_delay(k, k)
    correlation = following.correlation[delay, k, k]
    if copied:
        message = "u is q, to the last bit: are the commands those that were sent?"
        yield _warning("commands-are-positions", report.name, message)
    elif not following.moves[k]:
        message = f"its command moves by {report.u[1] - report.u[0]:.3g} alone: its servo is not determined"
        yield _warning("idle-command", report.name, message)
    elif correlation < TUNING.ignores:
        message = f"it does not follow its command (correlation {correlation:.2g})"
        yield _warning("not-following", report.name, message)
    elif DELAYS[delay] < 0:
        message = f"positions come {-1000 * DELAYS[delay]:.0f} ms before commands: are rows shifted?"
        yield _warning("ahead-of-command", report.name, message)


def _sparse(clocks: Sequence[Clock]) -> Iterator[Diagnostic]:
    for clock in clocks:
        # said once: logs of one robot have one rate
        if clock.sample_rate < TUNING.sparse_rate:
            message = (
                f"{clock.sample_rate:.3g} Hz: delays and friction need {TUNING.sparse_rate:g} Hz or more"
            )
            yield Diagnostic("warning", "sparse", f"trajectory {clock.name}", None, message)
            return


def _warning(code: str, joint: str, message: str) -> Diagnostic:
    return Diagnostic("warning", code, f"joint {joint!r}", None, message)
