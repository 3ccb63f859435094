"""Checks of logs of commanded positions: ranges of the signals, tracking of the commands, wrong commands."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from spelgen.arm.actuation import Drives
from spelgen.arm.configured_arm import Arm
from spelgen.errors import Diagnostic, LogError
from spelgen.identification.geometry_search import compare_hypotheses, kinds_of_servo_faults
from spelgen.identification.log_geometry import GeometryProblem
from spelgen.identification.motion_samples import DriveLog
from spelgen.identification.tuning import GEOMETRY, HINTS
from spelgen.labels import UNITS, counted
from spelgen.listing import Listing, number
from spelgen.log_checks.geometry_finding import geometry_finding, stated_hypothesis
from spelgen.log_checks.report import JointFollowing, JointReport, percent, signal_tables
from spelgen.log_checks.robot_checks import POSITION_CHECKS, JointEvidence
from spelgen.log_checks.statistics import quantisation_step
from spelgen.logs.checks import OF_ONE, Check, Findings, run_checks
from spelgen.logs.filtering import derivative
from spelgen.logs.joint_signals import Advice, joint_keys, mapping_line
from spelgen.logs.parquet_files import UNLESS_NORMALISED
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory, delayed_commands, require_commands, split_at_gaps
from spelgen.logs.tuning import SAMPLES, SIGNALS
from spelgen.settings.log_mapping import SCALES

MOVING = SAMPLES.moving
# [s] Candidates for the delay of positions after commands. Negative delays show that rows of the log are shifted; the
# delays of low-cost servos are below 0.2 s.
DELAYS = np.linspace(-0.1, 0.4, 51).round(9)
NO_DELAY = int(np.argmin(np.abs(DELAYS)))
FILTER_SAMPLES = 12  # [1] Smallest number of samples of a segment without gaps, for the smoothing polynomial.
FOLLOWS = SIGNALS.agreement
# [rad, m] A larger constant distance of commands from positions shows that their zeros differ; loads displace servos
# by less.
OTHER_ZERO = {"revolute": GEOMETRY.serious_angle, "prismatic": GEOMETRY.serious_shift}
# Encoders of bus servos have 2**k counts per turn, with k from 10 to 14. Positions therefore have the same quantisation
# step at all joints: 360/2**k degrees, or 360/(2**k - 1) with LeRobot. LeRobot's normalised positions have another step
# at each joint: 200 divided by the counts of the joint's calibrated range. NORMALISED_RANGE is the largest magnitude of
# a normalised position. NORMALISED_STEPS are the smallest and the largest quantisation step of normalised positions,
# for calibrated ranges of 800 to 5000 counts.
NORMALISED_RANGE, NORMALISED_STEPS = 100.001, (0.04, 0.25)
# SAME_STEP: the steps of all joints count as equal if smallest and largest differ by less than this fraction.
# ENCODER_STEP: a step counts as a step of an encoder if it differs from 360/2**k degrees by less than this fraction.
SAME_STEP, ENCODER_STEP = 1e-3, 4e-3


def find_servo_unit(logs: Sequence[Trajectory], joints: Sequence[str], unit: str) -> Advice | None:
    """Return a finding if the positions of servos have another unit than `unit`, one of `ANGLES`; else None.

    Encoders have quantisation steps of 360 / 2**k degrees, with k from 10 to 14. If the positions have such steps in
    `unit`, it is right. Otherwise the finding is the first of these:

    1. In another of the units `ANGLES`, the positions have the steps of encoders: this is their unit.
    2. `unit` is "deg", but all joints move by less than 0.1 rad; read in radians, a joint moves by more than 0.5 rad
       and less than two turns: the unit is "rad".
    3. `unit` is "deg", and the step differs from joint to joint: the positions are normalised by LeRobot, to -100..100
       over the calibrated range of each joint.

    Args:
        logs: recordings, with positions converted to radians from `unit`.
        joints: names of the joints.
        unit: unit of the positions in the mapping.
    """
    q = np.concatenate([log.q for log in logs])
    steps, width = _steps(logs), float(np.ptp(q, axis=0).max())
    if _are_encoders(steps):
        return None
    for other in ANGLES:
        factor = SCALES.get(other, 1.0) / SCALES.get(unit, 1.0)
        message = f"positions in {other}: they move by up to {width:.3g} rad when read in {unit}"
        keys = {"units": {"q": other}}
        if other != unit and _are_encoders(steps * factor) and width * factor < 4 * np.pi:
            counts = 360 / float(np.nanmedian(steps * factor))
            return Advice(f"{message}, in steps of an encoder with {counts:.0f} counts", keys=keys)
        if unit == "deg" and other == "rad" and width < 0.1 and 0.5 < width * factor < 4 * np.pi:
            return Advice(message, keys=keys)
    low, high = NORMALISED_STEPS
    is_normalised = unit == "deg" and np.abs(q).max() <= np.radians(NORMALISED_RANGE)
    is_normalised &= np.isfinite(steps).sum() > 1 and np.nanmin(steps) >= low and np.nanmax(steps) <= high
    if not is_normalised or np.nanmax(steps) - np.nanmin(steps) < SAME_STEP * np.nanmax(steps):
        return None
    listed = ", ".join(f"{x} {step:.4f}" for x, step in zip(joints, steps, strict=True) if np.isfinite(step))
    return Advice(
        f"degrees of another step for each joint ({listed}), as normalised positions of LeRobot have"
    )


def _steps(logs: Sequence[Trajectory]) -> np.ndarray:
    """Return the quantisation steps (n,) [degrees] of the positions; NaN for positions that are not quantised."""
    return np.degrees([quantisation_step(column) for column in np.concatenate([x.q for x in logs]).T])


def _are_encoders(steps: np.ndarray) -> bool:
    """Return True if most quantisation steps (J,) [degrees] of J joints are about 360 / 2**k, k from 10 to 14.

    Encoders of position servos have these steps.
    """
    counts = 360 / steps[np.isfinite(steps)]
    powers = np.clip(np.round(np.log2(counts)), 10, 14)
    return bool(len(counts) and (np.abs(counts / 2**powers - 1) < ENCODER_STEP).mean() > 0.5)


# [s] Candidates for the delay of positions after commands; the test of senses, order and zeros of the joints uses the
# candidate of smallest residual.
COMMAND_DELAYS = (0.0, 0.02, 0.035, 0.05, 0.075, 0.1)
ONE_ZERO = "one zero of positions and commands"
ANGLES = ("rad", "deg", "turns", "mrad")  # Units of the positions of servos.
UNIT: Check[Sequence[JointReport]] = Check(
    "degrees", "error", expected="the unit that 'units' under 'logs' states, rad by default"
)
NORMALISED: Check[Sequence[JointReport]] = Check(
    "normalised", "error", expected="degrees, with the step of the encoders (4096 counts: 0.0879)",
    do="write 'units: {q: normalised}' and 'calibration:' with the content of LeRobot's calibration file under 'logs' "
    "in the robot's YAML",
)  # fmt: skip


class Following(NamedTuple):
    """Tracking of the commands u of n position servos by the positions q.

    Attributes:
        moves: (n,) True for joints whose command changes.
        delay: (n, n) [s] delay of the position of joint j (column) after the command of joint i (row) at which their
            correlation is largest, or most negative.
        correlation: (n, n) correlation of the command of joint i (row) with the position of joint j (column), at this
            delay.
        gain: (n,) amplitude of a joint's motion divided by the amplitude of the joint's command.
        offset: (n,) [rad, m] mean of u - q if its magnitude exceeds two standard deviations of u - q, else 0: a smaller
            mean may be due to a changing load.
        joints: tracking errors and lag of each joint.
        saturation: (n,) [rad, m] distance of a position from its command at which the servo's torque is at its limit;
            infinity if it is unknown.
    """

    moves: np.ndarray
    delay: np.ndarray
    correlation: np.ndarray
    gain: np.ndarray
    offset: np.ndarray
    joints: list[JointFollowing]
    saturation: np.ndarray


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
        # The means of u and of q are subtracted, since they differ by the static error of the servo.
        covariance = (u - u.mean(axis=0)).T @ (q - q.mean(axis=0)) / len(u)
        correlations.append(covariance / np.maximum(np.outer(u.std(axis=0), q_std), 1e-6))
        tracking_rms.append(np.sqrt(np.mean((u - q) ** 2, axis=0)))
    stacked = np.array(correlations)
    # In periodic motion, positions also have a negative correlation with the commands half a period before. A negative
    # correlation is therefore used only if its magnitude exceeds the largest positive correlation by 0.1.
    is_opposite = -stacked.min(axis=0) > stacked.max(axis=0) + 0.1
    best = np.where(is_opposite, stacked.argmin(axis=0), stacked.argmax(axis=0))
    correlation = np.take_along_axis(stacked, best[None], axis=0)[0]
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
    return Following(moves, DELAYS[best], correlation, gain, offset, joints, saturation)


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

    A command acts from one sample to the next. It is compared with the position at the middle of this interval.
    """
    return np.asarray((x[1:] + x[:-1]) / 2)


class CommandFault(NamedTuple):
    """Finding that the logged commands of a joint are not the commands that its servo tracked.

    Attributes:
        got: text about the logged commands.
        expected: text about right commands; findings of several joints with the same text are one error.
        keys: settings of the joint, in the group `logs`, that correct the log; empty if there are none.
        do: remedy if there are no such settings.
    """

    got: str
    expected: str
    keys: Mapping[str, object] = {}
    do: str = ""


class ServoLogs:
    """Checks of logs of commanded positions, on all trajectories together: `add` each trajectory, then `check`."""

    def __init__(self, arm: Arm) -> None:
        self._arm, self._names = arm, arm.chain.joint_names
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
        saturation = np.full(len(self._names), np.inf)
        for k, coordinate in enumerate(self._arm.chain.coordinates):
            kp = self._arm.settings.joint(coordinate.name).kp
            if coordinate.effort and kp:
                saturation[k] = coordinate.effort / kp
        self._check_units(summary)
        following, completed = measure_following(self._logs, saturation), list(reports)
        if following is None:
            message = f"no {FILTER_SAMPLES} samples without a gap: no servo is determined"
            summary.notes.append(Diagnostic("warning", "idle-command", "logs", None, message))
        else:
            completed = [replace(x, following=y) for x, y in zip(reports, following.joints, strict=True)]
        # Commands are compared only with sound positions: a wrong unit or a wrap of the positions has been reported.
        if following is not None and not summary.errors:
            wrong = self._check_commands(following, saturation, summary)
            for k in set(range(len(completed))) - wrong:
                summary.notes.extend(_command_warning(k, completed[k], following, self._logs))
            if not summary.errors and following.moves.any():
                self._check_geometry(summary)
        for coordinate, report in zip(self._arm.chain.coordinates, completed, strict=True):
            evidence = JointEvidence(coordinate, report, self._logs[0].mapping.offset("q", coordinate.name))
            for check, found in run_checks(POSITION_CHECKS, evidence):
                summary.add(check, found.message, f"joint {coordinate.name!r}")
        for log in self._logs:
            if log.sample_rate < 20.0:
                message = f"{log.sample_rate:.3g} Hz: delays and friction need 20 Hz or more"
                summary.notes.append(Diagnostic("warning", "sparse", f"trajectory {log.name}", None, message))
                # the low rate is reported for one trajectory only: logs of one robot have the same sample rate
                break
        return completed, (*signal_tables(completed, ("q", "u")), _following_table(completed))

    def _check_geometry(self, summary: Findings) -> None:
        """Add a finding to `summary` if another sense, order or zero of the joints explains the position errors better.

        The hypothesis must explain 95 % of the position errors on average, and 80 % at each joint: servos with
        backlash, for example, have a large residual with every hypothesis.
        """
        coarse, accepted = GEOMETRY.coarse_samples, set(self._logs[0].accepted)
        problems = self._geometry_problems()
        if not problems:
            return
        problem = min(problems, key=lambda x: x.thinned(coarse).fit(x.unchanged).misfit)
        unchanged, *better = compare_hypotheses(problem, kinds_of_servo_faults(self._arm.chain))
        if not better or {fault.code for fault in better[0].hypothesis.faults} <= accepted:
            return
        # The cost must fall by twice the bound for logs of torques. On simulated arms, right hypotheses lower it by 40
        # to 240. If the logged times are twice too long, a fault that no hypothesis corrects, the best hypothesis
        # lowers it by 20.
        is_sure = better[0].cost < unchanged.cost - 2 * GEOMETRY.needed
        errors = better[0].errors
        if is_sure and errors.max() <= GEOMETRY.no_advice and errors.mean() <= GEOMETRY.explained:
            summary.extend([geometry_finding(problem, self._logs[0].mapping, unchanged, better)])

    def _geometry_problems(self) -> list[GeometryProblem]:
        """Return least-squares problems that test hypotheses about the log, such as a reversed joint.

        Each problem fits the equation of motion to the torques kp (u - q) of position servos. Unknowns are the inertial
        parameters, the friction, which includes the damping of the servos, and the gain kp of each servo. There is one
        problem per delay of the command u in `COMMAND_DELAYS`, except delays for which u = q in all samples, and none
        for too few samples.
        """
        chain, alone = self._arm.chain, np.eye(len(self._names))
        collected = DriveLog(chain.joint_types, Drives(alone, alone), Preprocessing())
        for log in self._logs:
            collected.add(replace(log, tau=require_commands(log), u=None))
        samples, seconds = collected.samples(), sum(log.duration for log in self._logs)
        if samples is None or len(samples.values) < HINTS.fewest_samples / 4:
            return []
        stated, problems = stated_hypothesis(chain, self._logs[0].mapping), []
        for delay in COMMAND_DELAYS:
            # The fourth signal of the samples is the command u, collected in place of a torque. It becomes the position
            # error.
            signals = samples.at(np.tile([0.0, 0.0, 0.0, -delay], (len(self._names), 1))).copy()
            signals[..., 3] -= signals[..., 0]
            if signals[..., 3].any():
                delayed = samples._replace(values=signals[..., None])
                problems.append(GeometryProblem(chain, delayed, alone, seconds, stated).with_free_gains())
        return problems

    def _check_units(self, summary: Findings) -> None:
        """Add an error to `summary` if positions of one or of all recordings have another unit than the mapping states.

        If a recording has the quantisation steps of encoders in the stated unit, this unit is right for it, and the
        error names the other, faulty recordings. If there is no such recording, the error is about all recordings.
        Nothing is tested if `summary` already has an error, or if the mapping states several units for the joints or a
        unit that is not in `ANGLES`.
        """
        mapping = self._logs[0].mapping
        units = {mapping.unit("q", name) or "rad" for name in self._names}
        if len(units) > 1 or not units <= set(ANGLES) or summary.errors:
            return
        (unit,) = units
        findings = [(log, find_servo_unit([log], self._names, unit)) for log in self._logs]
        is_sound = any(_are_encoders(_steps([log])) for log, finding in findings if not finding)
        for log, finding in {str(x.keys): (log, x) for log, x in findings if x}.values():
            check = UNIT if finding.keys else NORMALISED
            if check.code in log.accepted:
                continue
            # The file reader warned that positions of a LeRobot data set, read as degrees, may be normalised. This
            # warning is omitted, since the error below states the unit.
            summary.notes[:] = [x for x in summary.notes if UNLESS_NORMALISED not in x.message]
            names = ", ".join(x.name for x, y in findings if y and y.keys == finding.keys)
            if is_sound:
                summary.add(replace(check, do=OF_ONE), finding.message, f"trajectory {names}", log.file)
            else:
                summary.add(check, finding.message, "all joints", keys=finding.keys)

    def _check_commands(self, following: Following, saturation: np.ndarray, summary: Findings) -> set[int]:
        """Add the faults of the commands to `summary`; return the indices of the joints with errors.

        Each recording is tested by itself. If a joint tracks its commands in some recordings, its error names the
        recordings with the fault.

        following: tracking of the commands in all recordings. saturation: see `measure_following`.
        """
        faults, sound = dict[str, dict[int, list[tuple[str, CommandFault]]]](), set[int]()
        for log in self._logs:
            tracking = following if len(self._logs) == 1 else measure_following([log], saturation)
            if tracking is None:
                continue
            new = _command_faults(tracking, log, self._names, is_only=len(self._logs) == 1)
            bounds = [OTHER_ZERO[x] for x in self._arm.chain.joint_types]
            for k in np.flatnonzero(np.abs(tracking.offset) > bounds).tolist():
                got = f"commands that are {tracking.offset[k]:.3g} above the positions throughout"
                new.setdefault(k, CommandFault(got, ONE_ZERO))
            for k, fault in new.items():
                faults.setdefault(fault.expected, {}).setdefault(k, []).append((log.name, fault))
            tracks = tracking.moves & (tracking.correlation.diagonal() > FOLLOWS)
            sound |= set(np.flatnonzero(tracks).tolist()) - new.keys()
        groups = dict[tuple[str, str], dict[int, CommandFault]]()
        for expected, by_joint in faults.items():
            for k, occurrences in by_joint.items():
                names = ", ".join(name for name, _ in occurrences) if k in sound else ""
                # A command offset in all recordings is no error, since the load of a soft servo has the same effect.
                # `_command_warning` yields a warning about it.
                if names or expected != ONE_ZERO:
                    groups.setdefault((expected, names), {})[k] = occurrences[0][1]
        for (expected, names), group in groups.items():
            fault = next(iter(group.values()))
            entries = {self._names[k]: x.keys for k, x in group.items() if x.keys}
            do = mapping_line(joint_keys(entries, self._names)) if entries else fault.do
            joints = f"joint {', '.join(repr(self._names[k]) for k in group)}"
            where = f"trajectory {names}, {joints}" if names else joints
            error = LogError(fault.got, element=where, expected=expected, do=OF_ONE if names else do)
            summary.errors.append(error)
        return {k for group in groups.values() for k in group}


def _command_faults(
    following: Following, log: Trajectory, joints: Sequence[str], *, is_only: bool
) -> dict[int, CommandFault]:
    """Return {index of a joint: finding} for joints whose logged commands cannot be the commands of their servo.

    The commands may belong to other joints, have another unit or sense than the positions, or be increments of the
    position.

    Args:
        following: tracking of the commands in a recording.
        log: the recording.
        joints: names of all joints.
        is_only: True if there are no other recordings. With other recordings, a single joint that moves like the
            command of another joint is no finding: it may be chance in one recording.
    """
    faults = dict[int, CommandFault]()
    correlations, mapping = following.correlation.diagonal(), log.mapping
    is_tracked = following.moves & (following.correlation > FOLLOWS).any(axis=1)
    exchanged = np.flatnonzero(is_tracked & (correlations < 0.5)).tolist()
    # In one of several recordings, a joint may rest at an obstacle while another joint happens to move like the command
    # of the resting joint. Commands therefore count as exchanged only if this is found for at least two joints.
    if len(exchanged) > 1 or is_only:
        for k in exchanged:
            source = int(following.correlation[:, k].argmax())
            is_found = following.correlation[source, k] > FOLLOWS
            keys = {"columns": {"u": mapping.column("u", joints[source])}} if is_found else {}
            got, do = "commands that other joints follow, and these do not", "check the names of the columns"
            faults[k] = CommandFault(got, "their own commands", keys, do)
    of_sum = np.zeros(len(joints)) if (correlations > FOLLOWS).all() else _sum_correlations(following, log)
    # Correlation and gain are measured at the delay of largest correlation: the delay of a slow servo is no fault.
    for k, (correlation, gain) in enumerate(zip(correlations, following.gain, strict=True)):
        if k in faults:
            continue
        # A joint whose command hardly changes may be held by dry friction: it moves less than the command.
        if correlation > FOLLOWS and (gain > 3 or (following.moves[k] and gain < 1 / 3)):
            units = _command_units(gain, mapping.unit("q", joints[k]), mapping.unit("u", joints[k]))
            got, do = f"positions that move {gain:.3g} times as far as commands", "log both in one unit"
            faults[k] = CommandFault(got, "both in the same unit", {"units": units} if units else {}, do)
        elif correlation < FOLLOWS < of_sum[k]:
            got = f"increments: the position follows the sum of the commands (correlation {of_sum[k]:.2g})"
            do = "log the commanded positions, or add the increments up"
            faults[k] = CommandFault(got, "commanded positions", do=do)
        elif following.moves[k] and correlation < -FOLLOWS:
            got = f"positions that move against commands (correlation {correlation:.2g})"
            do = "multiply the column of u or the column of q by -1: the setting 'sign' applies to both"
            faults[k] = CommandFault(got, "one sense", do=do)
    return faults


def _sum_correlations(following: Following, log: Trajectory) -> np.ndarray:
    """Return the correlation (n,) of each position with the sum of the commands of its joint.

    If the commands are increments, their sum is the position. If they are velocities, the sum divided by the sample
    rate is the position. The amplitude of the position must agree with one of both within a factor of 2, otherwise the
    result is 0 for this joint: any motion with the period of the commands is correlated with their sum.
    """
    u = log.q[0] + np.cumsum(require_commands(log), axis=0).clip(-1e6, 1e6)
    summed = measure_following([replace(log, u=u)], following.saturation)
    if summed is None:
        return np.zeros(len(following.gain))
    factors = summed.gain[:, None] / [1.0, 1.0 / log.sample_rate]
    is_sum = ((factors > 0.5) & (factors < 2)).any(axis=1)
    return np.where(is_sum, summed.correlation.diagonal(), 0.0)


def _command_units(gain: float, q: str | None, u: str | None) -> dict[str, str]:
    """Return the units of a joint's positions and commands, {"q": ..., "u": ...}, that explain the ratio `gain`.

    Only one of the two units is changed; {} is returned if no unit explains the ratio within 25 %.

    gain: amplitude of positions divided by amplitude of commands, both converted to SI units. q, u: units of positions
    and commands in the mapping; None: rad.
    """
    present = np.array([SCALES.get(x or "", 1.0) for x in (q, u)])
    candidates = []
    for pair in ((x, u or "rad") if is_q else (q or "rad", x) for x in ANGLES for is_q in (True, False)):
        scales = np.array([SCALES.get(x, 1.0) for x in pair]) / present
        candidates.append((abs(np.log(gain * scales[0] / scales[1])), dict(zip("qu", pair, strict=True))))
    distance, units = min(candidates, key=itemgetter(0))
    return units if distance < np.log(1.25) else {}


def _command_warning(
    k: int, report: JointReport, following: Following, logs: Sequence[Trajectory]
) -> Iterator[Diagnostic]:
    """Yield a warning if the logged command of joint k may not be the command that its servo tracks.

    Reasons: the command equals the position in all `logs`, with a shift by at most two rows; the command is nearly
    constant; the position does not track it; they differ by a constant offset; or the position is ahead of the command.
    """
    correlation, offset, delay = following.correlation[k, k], following.offset[k], following.delay[k, k]
    shift = next((x for x in (0, 1, 2, -1, -2) if all(_is_shifted(log, k, x) for log in logs)), None)
    if not following.moves[k]:
        # a constant command contains no information on the servo
        width = report.high["u"] - report.low["u"]
        motion = f"moves by only {width:.3g}" if width else "does not move"
        code, message = "idle-command", f"its command {motion}: its servo is not determined"
    elif shift is not None:
        # commands equal to positions: the logger wrote measured positions in place of commands
        code = "commands-are-positions"
        late = f", {counted(abs(shift), 'row')} {'later' if shift > 0 else 'earlier'}" * bool(shift)
        message = f"u is q{late}, to the last bit: are they the commands that were sent?"
    elif correlation < 0.5:
        code, message = "not-following", f"it does not follow its command (correlation {correlation:.2g})"
    elif abs(offset) > OTHER_ZERO[report.kind]:
        side = f"{UNITS[report.kind].position} {'above' if offset > 0 else 'below'} its position throughout"
        code = "command-offset"
        message = f"its command is {abs(offset):.3g} {side}: other zeros of q and u, or a servo too soft for its load"
    elif delay < 0:
        code = "ahead-of-command"
        message = f"positions come {-1000 * delay:.0f} ms before commands: are rows shifted?"
    else:
        return
    yield Diagnostic("warning", code, f"joint {report.name!r}", None, message)


def _is_shifted(log: Trajectory, k: int, rows: int) -> bool:
    """Return True if the commands of joint k are equal to its positions `rows` rows later."""
    q, u = log.q[:, k], require_commands(log)[:, k]
    n = len(q) - abs(rows)
    return bool(n > 0 and np.array_equal(q[max(rows, 0) :][:n], u[max(-rows, 0) :][:n]))


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
    return Listing("Following", head, rows, note)
