"""Check logs of commanded positions beside a robot: what they hold, how joints follow, and what is odd about it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from spelgen.errors import Diagnostic, LogError
from spelgen.listing import Listing
from spelgen.log_checks.following import DELAYS, NO_DELAY, TUNING, Following, measure_following
from spelgen.log_checks.report import JointReport, joint_report
from spelgen.log_checks.robot_checks import POSITION_CHECKS, JointEvidence
from spelgen.log_checks.servo_report import ServoJointReport, servo_tables
from spelgen.log_checks.statistics import Statistics
from spelgen.logs.checks import DEGREES, Findings, is_factor, run_checks
from spelgen.logs.trajectory import Trajectory, require_commands
from spelgen.settings.tuning.log_checks import LogCheckTuning

if TYPE_CHECKING:
    from spelgen.loaded_arm import LoadedArm

FOLLOWS = LogCheckTuning().agreement


class ServoLogs:
    """Check logs of commanded positions beside their arm."""

    def __init__(self, arm: LoadedArm) -> None:
        self._arm = arm
        self._logs: list[Trajectory] = []

    def add(self, trajectory: Trajectory) -> None:
        """Take in a trajectory. Raises LogError without commands."""
        require_commands(trajectory)
        self._logs.append(trajectory)

    def joints(
        self, measured: Sequence[Statistics], summary: Findings
    ) -> tuple[list[ServoJointReport], tuple[Listing, ...]]:
        """Return how each joint follows its commands, with tables; add what is odd to the summary."""
        following = measure_following(self._logs, _saturation(self._arm))
        reports = []
        for k, coordinate in enumerate(self._arm.arm.coordinates):
            signals = joint_report(k, coordinate, measured)
            report = _joint(self._arm, k, signals, following)
            reports.append(report)
            wrong = _wrong_command(k, self._arm.arm.joint_names, following)
            if wrong is None:
                # some loggers write measured positions in place of commands
                copied = all(np.array_equal(log.q[:, k], require_commands(log)[:, k]) for log in self._logs)
                summary.notes.extend(_odd_command(k, report, following, copied=copied))
                for check, message in run_checks(POSITION_CHECKS, JointEvidence(coordinate, signals)):
                    summary.add(check, message, f"joint {coordinate.name!r}")
            else:
                summary.errors.append(wrong)
        # said once: logs of one robot have one rate
        sparse = [x.clock for x in measured if x.clock.sample_rate < TUNING.sparse_rate]
        for clock in sparse[:1]:
            message = (
                f"{clock.sample_rate:.3g} Hz: delays and friction need {TUNING.sparse_rate:g} Hz or more"
            )
            summary.notes.append(Diagnostic("warning", "sparse", f"trajectory {clock.name}", None, message))
        return reports, servo_tables(reports)


def _saturation(arm: LoadedArm) -> np.ndarray:
    """Return distances from the command (n,) at which servos give all they can; infinite where that is not known."""
    distances = np.full(len(arm.arm.coordinates), np.inf)
    for k, coordinate in enumerate(arm.arm.coordinates):
        kp = arm.settings.joint(coordinate.name).kp
        if coordinate.effort and kp:
            distances[k] = coordinate.effort / kp
    return distances


def _joint(arm: LoadedArm, k: int, signals: JointReport, following: Following) -> ServoJointReport:
    delay, lag = NO_DELAY, None
    if following.moves[k]:
        delay = following.best_delay(k, k)
        lag = float(DELAYS[delay])
    steady_state_error, saturated = None, None
    if len(following.steady_state_errors[k]):
        # nine tenths: where an arm leans on something it may be anywhere
        steady_state_error = float(np.quantile(np.abs(following.steady_state_errors[k]), 0.9))
    if arm.settings.joint(signals.name).kp is not None:
        saturated = float(following.saturated[k])
    return ServoJointReport(
        name=signals.name,
        kind=signals.kind,
        q=(signals.low["q"], signals.high["q"]),
        u=(signals.low["u"], signals.high["u"]),
        range_fraction=signals.range_fraction,
        noise=(signals.noise or {}).get("q"),
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


def _warning(code: str, joint: str, message: str) -> Diagnostic:
    return Diagnostic("warning", code, f"joint {joint!r}", None, message)
