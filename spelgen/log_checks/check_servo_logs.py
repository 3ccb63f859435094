"""Checks of logs of commanded positions: ranges of the signals, tracking of the commands, wrong commands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from spelgen.errors import Diagnostic, LogError
from spelgen.listing import Listing, number
from spelgen.log_checks.report import JointFollowing, JointReport, percent, signal_tables
from spelgen.log_checks.robot_checks import POSITION_CHECKS, JointEvidence
from spelgen.logs.checks import Check, Findings, run_checks
from spelgen.logs.filtering import derivative
from spelgen.logs.joint_signals import is_factor, mapping_line
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
FILTER_SAMPLES = 12  # [1] fewest samples of a gap-free piece, which the smoothing polynomial needs
FOLLOWS = SIGNALS.agreement
# Encoders of bus servos have 2**k counts per turn, with k from 10 to 14. Positions in degrees therefore have the same
# quantisation step at all joints: 360/2**k, or 360/(2**k - 1) with LeRobot. LeRobot's normalised positions have another
# step at each joint: 200 divided by the counts of the joint's calibrated range.
# NORMALISED_RANGE: largest magnitude of a normalised position. NORMALISED_STEPS: smallest and largest quantisation step
# of normalised positions, for calibrated ranges of 800 to 5000 counts.
NORMALISED_RANGE, NORMALISED_STEPS = 100.001, (0.04, 0.25)
# SAME_STEP: relative difference below which the steps of all joints count as equal. ENCODER_STEP: relative difference
# below which a step counts as a step of an encoder.
SAME_STEP, ENCODER_STEP = 1e-3, 4e-3


def find_normalised(joints: Sequence[JointReport]) -> str | None:
    """Find normalised positions of LeRobot that the mapping declares as degrees.

    Normalised positions have another quantisation step at each joint, positions in degrees have the encoder's step.
    """
    if max(joint.largest("q") for joint in joints) > np.radians(NORMALISED_RANGE):
        return None
    found = {joint.name: float(np.degrees(joint.steps["q"])) for joint in joints if joint.steps["q"]}
    steps = np.array(list(found.values()))
    low, high = NORMALISED_STEPS
    if len(steps) < 2 or steps.min() < low or steps.max() > high or np.ptp(steps) < SAME_STEP * steps.max():
        return None
    turns = 360 / steps
    is_encoder = np.abs(turns / 2 ** np.round(np.log2(turns)) - 1) < ENCODER_STEP
    if is_encoder.mean() > 0.5:
        return None
    values = ", ".join(f"{name} {step:.4f}" for name, step in found.items())
    return f"degrees of another step for each joint ({values}), as LeRobot's normalised positions have"


NORMALISED = Check(
    "normalised", "error", find_normalised, expected="degrees, with the step of the encoders (4096 counts: 0.0879)",
    do="write 'units: {q: normalised}' and 'calibration:' with the content of LeRobot's calibration file under 'logs' "
    "in the robot's YAML",
)  # fmt: skip


class Following(NamedTuple):
    """Tracking of the commands of n joints.

    Attributes:
        moves: (n,) True for joints whose command changes.
        delay: (n, n) [s] delay at which the magnitude of the correlation is largest.
        correlation: (n, n) correlation of the command of joint i (row) with the position of joint j (column), at this
            delay.
        gain: (n,) amplitude of a joint's motion divided by the amplitude of the joint's command.
        joints: tracking errors and lag of each joint.
    """

    moves: np.ndarray
    delay: np.ndarray
    correlation: np.ndarray
    gain: np.ndarray
    joints: list[JointFollowing]


def measure_following(logs: Sequence[Trajectory], saturation: np.ndarray) -> Following | None:
    """Return the tracking of the commands of n joints over all recordings; None if no recording is long enough.

    saturation: (n,) [rad, m] distance of a position from its command at which the servo's torque is at its limit;
    infinity if the limit is unknown.
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
        # means are subtracted, since the static error of a servo shifts them
        covariance = (u - u.mean(axis=0)).T @ (q - q.mean(axis=0)) / len(u)
        correlations.append(covariance / np.maximum(np.outer(u.std(axis=0), q_std), 1e-6))
        tracking_rms.append(np.sqrt(np.mean((u - q) ** 2, axis=0)))
    best = np.abs(correlations).argmax(axis=0)
    correlation = np.take_along_axis(np.array(correlations), best[None], axis=0)[0]
    moves = u_std > 0.01  # [rad, m] a command with a smaller standard deviation is constant with noise
    saturated = np.mean(np.abs(commands - q) > saturation, axis=0)
    joints = []
    for k, error in enumerate(_steady_state_errors(pieces)):
        delay_index = best[k, k] if moves[k] else NO_DELAY
        lag = float(DELAYS[delay_index]) + 0.0 if moves[k] else None  # + 0.0 turns -0 into 0
        fraction = float(saturated[k]) if np.isfinite(saturation[k]) else None
        joints.append(JointFollowing(lag, float(tracking_rms[delay_index][k]), error, fraction))
    gain = correlation.diagonal() * q_std / np.maximum(u_std, 1e-6)
    return Following(moves, DELAYS[best], correlation, gain, joints)


def _steady_state_errors(pieces: Sequence[Trajectory]) -> list[float | None]:
    """Return the steady-state error of each joint [rad, m]; None for a joint that never rests.

    It is the 90th percentile of |u - q| at samples at which the command is constant and the joint rests.
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
        # the 90th percentile, since the largest error may be due to contact with an obstacle
        errors.append(float(np.quantile(distance[resting], 0.9)) if resting.any() else None)
    return errors


def _midpoints(x: np.ndarray) -> np.ndarray:
    """Return the means (T - 1, ...) of neighbouring samples of x (T, ...), to match commands averaged over steps."""
    return np.asarray((x[1:] + x[:-1]) / 2)


class ServoLogs:
    """Checks of logs of commanded positions against the arm, over all trajectories."""

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        self._logs: list[Trajectory] = []

    def add(self, trajectory: Trajectory) -> None:
        """Add a trajectory. Raises LogError if it has no commands."""
        require_commands(trajectory)
        self._logs.append(trajectory)

    def check(
        self, reports: Sequence[JointReport], summary: Findings
    ) -> tuple[list[JointReport], tuple[Listing, ...]]:
        """Return the reports of the joints completed by their tracking, and tables; add findings to the summary."""
        names = self._arm.chain.joint_names
        saturation = np.full(len(names), np.inf)
        for k, coordinate in enumerate(self._arm.chain.coordinates):
            kp = self._arm.settings.joint(coordinate.name).kp
            if coordinate.effort and kp:
                saturation[k] = coordinate.effort / kp
        mapping = self._logs[0].mapping
        if all(mapping.unit("q", name) == "deg" for name in names):
            for normalised, found in run_checks([NORMALISED], reports, self._logs[0].accepted):
                summary.add(normalised, found.message, "all joints")
        following = measure_following(self._logs, saturation)
        if following is None:
            message = f"no {FILTER_SAMPLES} samples without a gap: no servo is determined"
            summary.notes.append(Diagnostic("warning", "idle-command", "logs", None, message))
        completed = []
        for k, (coordinate, report) in enumerate(zip(self._arm.chain.coordinates, reports, strict=True)):
            odd = None
            if following is not None:
                report = replace(report, following=following.joints[k])
                # True if the logger wrote measured positions in place of commands
                is_copy = all(np.array_equal(log.q[:, k], require_commands(log)[:, k]) for log in self._logs)
                odd = _odd_command(k, names, report, following, is_copy, mapping)
            completed.append(report)
            if isinstance(odd, LogError):
                summary.errors.append(odd)
                continue
            if odd is not None:
                summary.notes.append(odd)
            for check, found in run_checks(POSITION_CHECKS, JointEvidence(coordinate, report)):
                summary.add(check, found.message, f"joint {coordinate.name!r}")
        for log in self._logs:
            if log.sample_rate < 20.0:
                message = f"{log.sample_rate:.3g} Hz: delays and friction need 20 Hz or more"
                summary.notes.append(Diagnostic("warning", "sparse", f"trajectory {log.name}", None, message))
                break  # reported for one trajectory only: logs of one robot have the same sample rate
        return completed, (*signal_tables(completed, ("q", "u")), _following_table(completed))


def _odd_command(
    k: int,
    joints: Sequence[str],
    report: JointReport,
    following: Following,
    is_copy: bool,
    mapping: LogMapping,
) -> LogError | Diagnostic | None:
    """Return the finding about the command of joint k; None if there is none.

    It is an error if the logged command cannot be the command of this joint. is_copy: True if the logged command
    equals the logged position in all samples.
    """
    where = f"joint {joints[k]!r}"
    # correlation and gain at the delay with the largest correlation, so that a slow servo is not reported as a fault
    correlation, gain = following.correlation[k, k], following.gain[k]
    if is_copy:
        code, message = (
            "commands-are-positions",
            "u is q, to the last bit: are the commands those that were sent?",
        )
    # a ratio of amplitudes of about 57.3 or 1/57.3 shows that the command or the position is in degrees
    elif correlation > FOLLOWS and (is_factor(gain, 180 / np.pi) or is_factor(gain, np.pi / 180)):
        got = f"positions that move {gain:.3g} times as far as commands (180/pi is 57.3)"
        units = {"q": "deg", "u": "rad"} if gain > 1 else {"q": "rad", "u": "deg"}
        do = mapping_line({"joints": {joints[k]: {"units": units}}})
        return LogError(got, element=where, expected="both in radians", do=do)
    # a constant command contains no information on the servo
    elif not following.moves[k]:
        width = report.high["u"] - report.low["u"]
        code, message = "idle-command", f"its command moves by only {width:.3g}: its servo is not determined"
    elif correlation < -FOLLOWS:
        got = f"positions that move against commands (correlation {correlation:.2g})"
        return LogError(got, element=where, expected="one sense", do="check the signs of q and u")
    elif correlation < 0.5:
        # if another joint follows this command, the columns of the log are swapped
        for other, name in enumerate(joints):
            if following.correlation[k, other] > FOLLOWS:
                got = f"a command that joint {name!r} follows, and this one does not"
                do = "check the names of the columns"
                for source in np.flatnonzero(following.correlation[:, k] > FOLLOWS)[:1].tolist():
                    do = mapping_line(
                        {"joints": {joints[k]: {"columns": {"u": mapping.column("u", joints[source])}}}}
                    )
                return LogError(got, element=where, expected="its own command", do=do)
        code, message = "not-following", f"it does not follow its command (correlation {correlation:.2g})"
    elif following.delay[k, k] >= 0:
        return None
    else:
        early = f"{-1000 * following.delay[k, k]:.0f} ms"
        code, message = "ahead-of-command", f"positions come {early} before commands: are rows shifted?"
    return Diagnostic("warning", code, where, None, message)


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
