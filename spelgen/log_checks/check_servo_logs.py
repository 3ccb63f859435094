"""Checks of logs of commanded positions: ranges of the signals, tracking of the commands, wrong commands."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from spelgen.errors import Diagnostic, LogError
from spelgen.labels import UNITS
from spelgen.listing import Listing, number
from spelgen.log_checks.report import JointFollowing, JointReport, percent, signal_tables
from spelgen.log_checks.robot_checks import POSITION_CHECKS, JointEvidence
from spelgen.logs.checks import Check, Findings, run_checks
from spelgen.logs.filtering import derivative
from spelgen.logs.joint_signals import Advice, is_factor, mapping_line
from spelgen.logs.parquet_files import UNLESS_NORMALISED
from spelgen.logs.trajectory import Trajectory, delayed_commands, require_commands, split_at_gaps
from spelgen.logs.tuning import SAMPLES, SIGNALS

if TYPE_CHECKING:
    from spelgen.arm.configured_arm import Arm
    from spelgen.settings.log_mapping import LogMapping

MOVING = SAMPLES.moving
# [s] Candidates for the delay of positions after commands. Negative delays show that rows of the log are shifted; the
# delays of low-cost servos are below 0.2 s.
DELAYS = np.linspace(-0.1, 0.4, 51).round(9)
NO_DELAY = int(np.argmin(np.abs(DELAYS)))
FILTER_SAMPLES = 12  # [1] Smallest number of samples of a segment without gaps, for the smoothing polynomial.
FOLLOWS = SIGNALS.agreement
# [rad, m] Constant distance of commands from positions that shows another zero; servos deviate less under their load.
OTHER_ZERO = 0.17
# Encoders of bus servos have 2**k counts per turn, with k from 10 to 14. Positions therefore have the same quantisation
# step at all joints: 360/2**k degrees, or 360/(2**k - 1) with LeRobot. LeRobot's normalised positions have another step
# at each joint: 200 divided by the counts of the joint's calibrated range. NORMALISED_RANGE is the largest magnitude of
# a normalised position. NORMALISED_STEPS are the smallest and the largest quantisation step of normalised positions,
# for calibrated ranges of 800 to 5000 counts.
NORMALISED_RANGE, NORMALISED_STEPS = 100.001, (0.04, 0.25)
# SAME_STEP: relative difference below which the steps of all joints count as equal. ENCODER_STEP: relative difference
# below which a step counts as a step of an encoder.
SAME_STEP, ENCODER_STEP = 1e-3, 4e-3


def find_servo_unit(joints: Sequence[JointReport], unit: str) -> Advice | None:
    """Return a finding if the positions of servos have another unit than `unit`, "deg" or "rad"; else None.

    1. In one of both units, the positions have the quantisation steps of encoders (see the comment at
       `NORMALISED_RANGE`): this is their unit.
    2. `unit` is "deg", but all joints move by less than 0.1 rad; read in radians, a joint moves by 0.5 rad or more, but
       not by over two turns: the unit is "rad".
    3. `unit` is "deg", and each joint has another step: the positions are normalised.

    Args:
        joints: statistics of all joints, converted to radians from `unit`.
        unit: unit of the positions in the mapping.
    """
    steps = {joint.name: float(np.degrees(joint.steps["q"])) for joint in joints if joint.steps["q"]}
    ranges = np.array([joint.high["q"] - joint.low["q"] for joint in joints])
    other, factor = ("rad", 180 / np.pi) if unit == "deg" else ("deg", np.pi / 180)
    values = np.array(list(steps.values()))
    if _are_encoders(values):
        return None
    message = f"positions in {other}: they move by up to {ranges.max():.3g} rad when read in {unit}"
    if _are_encoders(values * factor):
        counts = 360 / float(np.median(values * factor))
        return Advice(
            f"{message}, in steps of an encoder with {counts:.0f} counts", keys={"units": {"q": other}}
        )
    if unit != "deg":
        return None
    if ranges.max() < 0.1 and 0.5 < ranges.max() * factor < 4 * np.pi:
        return Advice(message, keys={"units": {"q": other}})
    low, high = NORMALISED_STEPS
    is_normalised = max(joint.largest("q") for joint in joints) <= np.radians(NORMALISED_RANGE)
    is_normalised &= len(values) > 1 and values.min() >= low and values.max() <= high
    if not is_normalised or np.ptp(values) < SAME_STEP * values.max():
        return None
    listed = ", ".join(f"{name} {step:.4f}" for name, step in steps.items())
    return Advice(
        f"degrees of another step for each joint ({listed}), as LeRobot's normalised positions have"
    )


def _are_encoders(steps: np.ndarray) -> bool:
    """Return True if most quantisation steps (J,) [degrees] of J joints are about 360 / 2**k, k from 10 to 14.

    Encoders of position servos have these steps.
    """
    counts = 360 / steps
    powers = np.clip(np.round(np.log2(counts)), 10, 14)
    return bool(len(steps) and (np.abs(counts / 2**powers - 1) < ENCODER_STEP).mean() > 0.5)


UNIT: Check[Sequence[JointReport]] = Check(
    "degrees", "error", lambda _: None, expected="the unit that 'units' under 'logs' states, rad by default"
)
NORMALISED: Check[Sequence[JointReport]] = Check(
    "normalised", "error", lambda _: None, expected="degrees, with the step of the encoders (4096 counts: 0.0879)",
    do="write 'units: {q: normalised}' and 'calibration:' with the content of LeRobot's calibration file under 'logs' "
    "in the robot's YAML",
)  # fmt: skip


class Following(NamedTuple):
    """Tracking of the commands u of n position servos by the positions q.

    Attributes:
        moves: (n,) True for joints whose command changes.
        delay: (n, n) [s] delay of the position of joint j (column) after the command of joint i (row) at which the
            magnitude of their correlation is largest.
        correlation: (n, n) correlation of the command of joint i (row) with the position of joint j (column), at this
            delay.
        gain: (n,) amplitude of a joint's motion divided by the amplitude of the joint's command.
        offset: (n,) [rad, m] mean of u - q if its magnitude exceeds two standard deviations of u - q, else 0: a
            changing load causes smaller means.
        joints: tracking errors and lag of each joint.
    """

    moves: np.ndarray
    delay: np.ndarray
    correlation: np.ndarray
    gain: np.ndarray
    offset: np.ndarray
    joints: list[JointFollowing]


def measure_following(logs: Sequence[Trajectory], saturation: np.ndarray) -> Following | None:
    """Return the tracking of the commands of n position servos over all recordings: delay, correlation, errors.

    None is returned if no recording is long enough. saturation: (n,) [rad, m] distance of a position from its command
    at which the servo's torque is at its limit, for the fraction of saturated samples; infinity if it is unknown.
    """
    pieces: list[Trajectory] = []
    for log in logs:
        pieces += split_at_gaps(log, shortest=FILTER_SAMPLES)
    if not pieces:
        return None
    q = np.concatenate([_midpoints(piece.q) for piece in pieces])
    commands = np.concatenate([require_commands(piece)[:-1] for piece in pieces])
    q_std, u_std = q.std(axis=0), commands.std(axis=0)
    correlations, tracking_rms = [], []
    for delay in DELAYS.tolist():
        u = np.concatenate([delayed_commands(x, slice(0, len(x)), delay, 1)[:, 0] for x in pieces])
        # the means of u and q are subtracted, since the static error of a servo shifts them
        covariance = (u - u.mean(axis=0)).T @ (q - q.mean(axis=0)) / len(u)
        correlations.append(covariance / np.maximum(np.outer(u.std(axis=0), q_std), 1e-6))
        tracking_rms.append(np.sqrt(np.mean((u - q) ** 2, axis=0)))
    best = np.abs(correlations).argmax(axis=0)
    correlation = np.take_along_axis(np.array(correlations), best[None], axis=0)[0]
    # [rad, m] standard deviation below which a command is treated as constant with noise
    moves = u_std > 0.01
    saturated = np.mean(np.abs(commands - q) > saturation, axis=0)
    joints = []
    for k, error in enumerate(_steady_state_errors(pieces)):
        delay_index = best[k, k] if moves[k] else NO_DELAY
        lag = float(DELAYS[delay_index]) + 0.0 if moves[k] else None  # adding 0.0 to the lag turns -0 into 0
        fraction = float(saturated[k]) if np.isfinite(saturation[k]) else None
        joints.append(JointFollowing(lag, float(tracking_rms[delay_index][k]), error, fraction))
    gain = correlation.diagonal() * q_std / np.maximum(u_std, 1e-6)
    difference = commands - q
    offset = np.where(
        2 * difference.std(axis=0) < np.abs(difference.mean(axis=0)), difference.mean(axis=0), 0.0
    )
    return Following(moves, DELAYS[best], correlation, gain, offset, joints)


def _steady_state_errors(pieces: Sequence[Trajectory]) -> list[float | None]:
    """Return the steady-state error of each joint [rad, m]; None for a joint that is never at rest.

    It is the 90th percentile of |u - q|, command minus position, at samples with a constant command and a joint at
    rest.
    """
    distances, rests = [], []
    for piece in pieces:
        u = require_commands(piece)[:-1]
        velocity = np.gradient(derivative(piece.q, piece.sample_rate, 0), piece.t, axis=0)[1:]
        # the command must have been constant for 0.25 s: after this time an SO-101 is at rest
        span = max(1, round(0.25 * piece.sample_rate))
        resting = (u == np.roll(u, span, axis=0)) & (np.abs(velocity) < MOVING)
        resting[:span] = False
        rests.append(resting)
        distances.append(np.abs(u - _midpoints(piece.q)))
    errors: list[float | None] = []
    for distance, resting in zip(np.concatenate(distances).T, np.concatenate(rests).T, strict=True):
        # the error is the 90th percentile, since the largest error may be due to contact with an obstacle
        errors.append(float(np.quantile(distance[resting], 0.9)) if resting.any() else None)
    return errors


def _midpoints(x: np.ndarray) -> np.ndarray:
    """Return the means (T - 1, ...) of neighbouring samples of x (T, ...): positions in the middle between two samples.

    They are compared with the commands, which act from one sample to the next.
    """
    return np.asarray((x[1:] + x[:-1]) / 2)


class ServoLogs:
    """Checks of logs of commanded positions, on all trajectories together: `add` each trajectory, then `check`."""

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        self._logs: list[Trajectory] = []

    def add(self, trajectory: Trajectory) -> None:
        """Add a trajectory to the logs that `check` tests. Raises LogError if it has no commands."""
        require_commands(trajectory)
        self._logs.append(trajectory)

    def check(
        self, reports: Sequence[JointReport], summary: Findings
    ) -> tuple[list[JointReport], tuple[Listing, ...]]:
        """Return the joint reports with the tracking of the commands added, and the tables of the report.

        The findings are added to `summary`. reports: statistics of each joint.
        """
        names = self._arm.chain.joint_names
        saturation = np.full(len(names), np.inf)
        for k, coordinate in enumerate(self._arm.chain.coordinates):
            kp = self._arm.settings.joint(coordinate.name).kp
            if coordinate.effort and kp:
                saturation[k] = coordinate.effort / kp
        mapping = self._logs[0].mapping
        self._check_unit(reports, {mapping.unit("q", name) for name in names}, summary)
        following = measure_following(self._logs, saturation)
        if following is None:
            message = f"no {FILTER_SAMPLES} samples without a gap: no servo is determined"
            summary.notes.append(Diagnostic("warning", "idle-command", "logs", None, message))
        exchanged, summed = list[int](), following
        if following is not None and (following.correlation.diagonal() < FOLLOWS).any():
            exchanged = _exchanged_commands(following)
            if exchanged:
                summary.errors.append(_exchange_error(exchanged, names, following, mapping))
            sums = [x.q[0] + np.cumsum(require_commands(x), axis=0).clip(-1e6, 1e6) for x in self._logs]
            logs = [replace(log, u=u) for log, u in zip(self._logs, sums, strict=True)]
            summed = measure_following(logs, saturation)
        completed = []
        for k, (coordinate, report) in enumerate(zip(self._arm.chain.coordinates, reports, strict=True)):
            if following is not None:
                report = replace(report, following=following.joints[k])
            completed.append(report)
            if k in exchanged:
                continue
            if following is not None and summed is not None:
                wrong = _command_error(k, report, following, summed.correlation[k, k])
                if wrong is not None:
                    summary.errors.append(wrong)
                    continue
                summary.notes.extend(_command_warning(k, report, following, self._logs))
            for check, found in run_checks(
                POSITION_CHECKS, JointEvidence(coordinate, report, mapping.offset("q", coordinate.name))
            ):
                summary.add(check, found.message, f"joint {coordinate.name!r}")
        for log in self._logs:
            if log.sample_rate < 20.0:
                message = f"{log.sample_rate:.3g} Hz: delays and friction need 20 Hz or more"
                summary.notes.append(Diagnostic("warning", "sparse", f"trajectory {log.name}", None, message))
                # the low rate is reported for one trajectory only: logs of one robot have the same sample rate
                break
        return completed, (*signal_tables(completed, ("q", "u")), _following_table(completed))

    def _check_unit(
        self, reports: Sequence[JointReport], units: Collection[str | None], summary: Findings
    ) -> None:
        """Add an error to `summary` if the positions have another unit than the mapping states.

        Nothing is tested unless all joints have the same unit in the mapping. units: the different units of the joints'
        positions in the mapping.
        """
        (unit, *others) = units
        if others or unit not in (None, "rad", "deg"):
            return
        finding = find_servo_unit(reports, unit or "rad")
        if finding is None:
            return
        check = UNIT if finding.keys else NORMALISED
        # The warning of the file reader that degrees of LeRobot may be normalised positions is omitted: this error
        # states more.
        summary.notes[:] = [x for x in summary.notes if UNLESS_NORMALISED not in x.message]
        if check.code not in self._logs[0].accepted:
            summary.add(check, finding.message, "all joints", keys=finding.keys)


def _exchanged_commands(following: Following) -> list[int]:
    """Return the indices of the joints whose command is tracked by another joint, and not by the joint itself."""
    is_tracked = following.moves & (following.correlation > FOLLOWS).any(axis=1)
    return np.flatnonzero(is_tracked & (following.correlation.diagonal() < 0.5)).tolist()


def _exchange_error(
    exchanged: Sequence[int], joints: Sequence[str], following: Following, mapping: LogMapping
) -> LogError:
    """Return the error about joints whose commands are tracked by other joints.

    The error names the setting with the right column of each joint. exchanged: indices of the joints from
    `_exchanged_commands`. joints: names of all joints. mapping: mapping of the logs.
    """
    entries = {}
    for k in exchanged:
        for source in np.flatnonzero(following.correlation[:, k] > FOLLOWS)[:1].tolist():
            entries[joints[k]] = {"columns": {"u": mapping.column("u", joints[source])}}
    do = mapping_line({"joints": entries}) if entries else "check the names of the columns"
    where = f"joint {', '.join(repr(joints[k]) for k in exchanged)}"
    got = "commands that other joints follow, and these do not"
    return LogError(got, element=where, expected="their own commands", do=do)


def _command_error(k: int, report: JointReport, following: Following, of_sum: float) -> LogError | None:
    """Return the error that the logged commands of joint k cannot be its commands; None if they can.

    The commands may be in another unit or sense than the positions, or be increments of the position. of_sum:
    correlation of the position with the cumulative sum of the commands, which is high for increments.
    """
    # Correlation and gain are those at the delay of largest correlation, so that a slow servo is not reported as a
    # fault.
    correlation, gain = following.correlation[k, k], following.gain[k]
    # a gain (ratio of amplitudes) of about 57.3 or 1/57.3 shows that the command or the position is in degrees
    if correlation > FOLLOWS and (is_factor(gain, 180 / np.pi) or is_factor(gain, np.pi / 180)):
        got = f"positions that move {gain:.3g} times as far as commands (180/pi is 57.3)"
        units = {"q": "deg", "u": "rad"} if gain > 1 else {"q": "rad", "u": "deg"}
        expected, do = "both in radians", mapping_line({"joints": {report.name: {"units": units}}})
    elif of_sum > FOLLOWS > correlation:
        got = f"increments: the position follows the sum of the commands (correlation {of_sum:.2g})"
        expected, do = "commanded positions", "log the commanded positions, or add the increments up"
    elif following.moves[k] and correlation < -FOLLOWS:
        got = f"positions that move against commands (correlation {correlation:.2g})"
        expected = "one sense"
        do = "multiply the column of u or that of q by -1: the setting 'sign' applies to both"
    else:
        return None
    return LogError(got, element=f"joint {report.name!r}", expected=expected, do=do)


def _command_warning(
    k: int, report: JointReport, following: Following, logs: Sequence[Trajectory]
) -> Iterator[Diagnostic]:
    """Yield a warning if the logged command of joint k may not be the command that its servo tracks.

    The command equals the position in all `logs`, hardly changes, is not tracked, has a constant distance from the
    position, or comes after it.
    """
    correlation, offset, delay = following.correlation[k, k], following.offset[k], following.delay[k, k]
    if all(np.array_equal(log.q[:, k], require_commands(log)[:, k]) for log in logs):
        # commands equal to positions: the logger wrote measured positions in place of commands
        code = "commands-are-positions"
        message = "u is q, to the last bit: are the commands those that were sent?"
    elif not following.moves[k]:
        # a constant command contains no information on the servo
        width = report.high["u"] - report.low["u"]
        motion = f"moves by only {width:.3g}" if width else "does not move"
        code, message = "idle-command", f"its command {motion}: its servo is not determined"
    elif correlation < 0.5:
        code, message = "not-following", f"it does not follow its command (correlation {correlation:.2g})"
    elif abs(offset) > OTHER_ZERO:
        side = f"{UNITS[report.kind].position} {'above' if offset > 0 else 'below'} its position throughout"
        code = "command-offset"
        message = f"its command is {abs(offset):.3g} {side}: other zeros of q and u, or a servo too soft for its load"
    elif delay < 0:
        code = "ahead-of-command"
        message = f"positions come {-1000 * delay:.0f} ms before commands: are rows shifted?"
    else:
        return
    yield Diagnostic("warning", code, f"joint {report.name!r}", None, message)


def _following_table(joints: Sequence[JointReport]) -> Listing:
    head = ("joint", "lag", "tracking RMS", "steady-state error", "saturated")
    rows = []
    for joint in joints:
        x = joint.following or JointFollowing()
        lag = "-" if x.lag is None else f"{1000 * x.lag:.0f} ms"
        tracking, error = (number(y and 1000 * y) for y in (x.tracking_rms, x.steady_state_error))
        rows.append((joint.name, lag, tracking, error, percent(x.saturated, 1)))
    note = (
        "lag: delay of positions after commands; tracking RMS: delayed command minus position; steady-state error: "
        "90th percentile of the distance from the command at rest [mrad, mm]; saturated: fraction of time with "
        "kp (u - q) beyond the effort limit, if kp is set."
    )
    return Listing("Following", head, tuple(rows), note)
