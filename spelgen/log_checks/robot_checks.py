"""Checks of logs against the robot's URDF: limits of the joints, and the gravity torque of the URDF."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from math import inf, pi
from typing import NamedTuple

import numpy as np
from scipy.linalg import orth

from spelgen.arm.arm import Chain, Coordinate
from spelgen.dynamics.regressor_dynamics import regressor
from spelgen.identification.motion_samples import MotionSamples
from spelgen.identification.reference_inertials import ReferenceInertials
from spelgen.labels import UNITS
from spelgen.log_checks.report import MEASURES, GravityFit, JointReport
from spelgen.log_checks.statistics import has_few_levels
from spelgen.logs.checks import Check
from spelgen.logs.joint_signals import mapping_line, plain_number
from spelgen.logs.trajectory import QUANTITIES
from spelgen.logs.tuning import SAMPLES, SIGNALS

SAY_UNIT = "write 'units: {tau: ...}' or a 'gain' under 'logs' in the robot's YAML; 'Nm' confirms the unit"


@dataclass(frozen=True)
class RobotCheckTuning:
    """Thresholds of the checks of logs against the robot."""

    # [rad, m] Tolerance of position limits, for positions that a logger has rounded.
    limit_rounding: float = 1e-3
    # [1] Limit of the correlation c of logged torques with the URDF's gravity torques. The logged torques contain
    # gravity if c > `seen`, and lack gravity if |c| < 1 - `seen`. Otherwise nothing is concluded.
    seen: float = 0.7
    # [1] Gravity is visible in logged torques if the standard deviation of the gravity torque is at least this fraction
    # of the standard deviation of the logged torque. The fraction was chosen on logs of a UR10e.
    visible: float = 0.2
    # [rad, m] Hypotheses about a log, such as a reversed joint, are not tested if its positions range over less than
    # this value: presliding friction may then dominate the torques. On simulated arms, wrong hypotheses fit best if
    # positions range over 0.02, but not if positions range over 0.1.
    smallest_motion: float = 0.05
    # [1] The unit of a joint's torque is checked only if gravity loads the joint enough: the standard deviation of its
    # gravity torque by the URDF must be at least this fraction of the largest standard deviation of all joints. At
    # other joints, such as wrists, a payload may multiply the gravity torque.
    loaded: float = 0.01
    # [1] A column of the regressor is linearly dependent on others if the norm of its residual after projection onto
    # them is below this fraction of its norm.
    dependent: float = 1e-8


TUNING = RobotCheckTuning()


def fit_gravity(arm: Chain, motion: MotionSamples, inertials: np.ndarray) -> list[GravityFit]:
    """Return the fit of the gravity torque of the URDF to the logged torque, for each joint of the arm.

    The fit shows whether the torques contain gravity, and in which unit they are.

    Args:
        arm: kinematics and gravity.
        motion: samples with torques.
        inertials: (10 B,) inertial parameters of the B bodies, of the URDF or guessed (see `ReferenceInertials`).
    """
    # at least 100 samples are required: with fewer samples gravity and friction are confounded
    q, qd, qdd = motion.motion
    if len(q) < 100:
        return [GravityFit()] * q.shape[1]
    still = np.zeros_like(q)
    rows = regressor(arm, q, still, still)  # rows: (S, n, 10 B) for S samples and B bodies
    load = rows @ inertials
    # friction and the joint's own inertia are removed, since in a slow swing they are correlated with gravity
    friction = np.stack([np.ones_like(qd), qd, np.tanh(qd / SAMPLES.moving), qdd], axis=2)
    fits = []
    for joint in range(qd.shape[1]):
        signals = np.column_stack([motion.tau[:, joint], load[:, joint], rows[:, joint]])
        fits.append(_fit_joint(signals, friction[:, joint]))
    return fits


def _fit_joint(signals: np.ndarray, friction: np.ndarray) -> GravityFit:
    """Return the fit of gravity to the torque of one joint in S samples.

    signals: (S, 2 + K): the torque, the gravity torque of the URDF, and the K regressor columns of gravity. friction:
    (S, F) columns of friction and inertia, which are removed from the signals by projection.
    """
    remainders = _without(friction, signals)
    lengths = np.linalg.norm(remainders, axis=0)
    # `is_rounding`: True for signals that consist only of friction and inertia, or are constant. After the projection,
    # only rounding errors of them remain.
    is_rounding = lengths <= TUNING.dependent * np.linalg.norm(signals, axis=0)
    largest = max(1.0, float(np.abs(signals[:, 2:]).max(initial=0.0)))
    is_seen = lengths[2:] > TUNING.dependent * largest * np.sqrt(len(signals))
    # No fit is possible if the torque is constant, as of a motor that is off, or if gravity never loads the joint.
    if is_rounding[0] or not is_seen.any():
        return GravityFit()
    torque, load = remainders[:, 0], remainders[:, 1]
    unexplained = _without(remainders[:, 2:][:, is_seen], torque)
    explained = 1.0 - float(unexplained @ unexplained) / float(torque @ torque)
    if is_rounding[1]:
        return GravityFit(explained, relative_deviation=0.0)
    product = float(load @ torque)
    correlation = product / float(lengths[0] * lengths[1])
    deviation = float(signals[:, 1].std() / signals[:, 0].std())
    return GravityFit(explained, product / float(load @ load), correlation, deviation)


def _without(columns: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the residual of signals `values` after projection onto the span of `columns` (least squares).

    columns: (S, C) for S samples. values: (S,) or (S, K).
    """
    basis = orth(columns, rcond=TUNING.dependent)
    return np.asarray(values - basis @ (basis.T @ values))


class JointEvidence(NamedTuple):
    """A joint of the URDF and its statistics over all trajectories: the input of each check in `CHECKS`.

    coordinate: the joint. report: its statistics. offset: zero offset of its positions in the column mapping [rad, m].
    """

    coordinate: Coordinate
    report: JointReport
    offset: float = 0.0

    def limits(self) -> tuple[float, float]:
        """Return the lower and upper position limit [rad, m]; infinity for a limit that does not exist."""
        lower, upper = self.coordinate.lower, self.coordinate.upper
        if self.coordinate.continuous:
            lower = upper = None
        return -inf if lower is None else lower, inf if upper is None else upper

    def shows_unit(self, reference: ReferenceInertials) -> bool:
        """Return True if the torque contains gravity of about the magnitude of `reference`: its unit is then right."""
        gravity = self.report.gravity
        return (gravity.correlation or 0.0) > TUNING.seen and not reference.is_other_unit(
            gravity.factor or 1.0
        )


def move_in_phase(motion: np.ndarray) -> bool:
    """Return True if two or more joints move, and their positions (S, n) [rad, m] are linear functions of one variable.

    This variable explains all but 1 % of the variance of the positions, which are first divided by their standard
    deviations. Joints that stay within `TUNING.smallest_motion` are omitted.
    """
    moved = motion[:, np.ptp(motion, axis=0) > TUNING.smallest_motion]
    variances = np.linalg.eigvalsh(np.atleast_2d(np.corrcoef(moved.T))) if moved.shape[1] > 1 else np.ones(2)
    return bool(variances[:-1].sum() < 0.01 * variances[-1])


def find_beyond_limits(joint: JointEvidence) -> str | None:
    """Return a message about measured or commanded positions beyond the position limits; None if there are none.

    If all positions are within the limits after a shift by one revolution, the message names the setting for it.
    """
    findings = []
    (lower, upper), unit = joint.limits(), UNITS[joint.coordinate.joint_type].position
    lower, upper = lower - TUNING.limit_rounding, upper + TUNING.limit_rounding
    ranges = {
        name: (joint.report.low[name], joint.report.high[name])
        for name in ("q", "u")
        if name in joint.report.low
    }
    for name, (low, high) in ranges.items():
        if low < lower:
            findings.append(f"{name} down to {low:.4g} {unit}, the limit is {joint.limits()[0]:z.4g}")
        if high > upper:
            findings.append(f"{name} up to {high:.4g} {unit}, the limit is {joint.limits()[1]:z.4g}")
    is_limited = joint.coordinate.joint_type == "revolute" and upper - lower < 2 * pi
    # Shifts by one revolution are tried: a driver that logs angles from 0 to 360 degrees logs -90 degrees as 270
    # degrees.
    for shift in (-2 * pi, 2 * pi) if findings and is_limited else ():
        if all(lower <= low + shift and high + shift <= upper for low, high in ranges.values()):
            offset = plain_number(joint.offset + shift, 8)
            line = mapping_line({"joints": {joint.coordinate.name: {"offset": offset}}})
            return f"{findings[0]}: another turn; {line}"
    return "; ".join(findings) or None


def find_above(limit: str, quantity: str, joint: JointEvidence) -> str | None:
    """Return a message if a signal, "qd" or "tau", exceeds the joint's limit, "velocity" or "effort"; else None."""
    limits = {"velocity": joint.coordinate.velocity, "effort": joint.coordinate.effort}
    bound, unit = limits[limit], asdict(UNITS[joint.coordinate.joint_type])[MEASURES[quantity]]
    largest = joint.report.largest(quantity)
    # a limit may be exceeded by 1 %, due to noise
    if not bound or largest <= bound * 1.01:
        return None
    return f"{limit} up to {largest:.4g} {unit}, the limit is {bound:.4g}"


def torque_factors(
    joints: Sequence[JointEvidence],
    undeclared: Sequence[bool],
    loaded: Sequence[bool] | np.ndarray,
    reference: ReferenceInertials,
) -> list[np.ndarray]:
    """Return candidates for factors (n,) on the torques of n joints that correct a wrong unit of torques.

    Only joints are used that are True in both masks and whose torques show gravity clearly. For such a joint, r is the
    gravity in the logged torques divided by the gravity torque of the URDF; r is negative if the torques have the
    opposite sense. Wrong inertials may explain an |r| from 1/5 to 5. For any other r there is a candidate with the
    factor 1 / r for this joint and 1 for all others. If all joints are `undeclared` and the median of r over the joints
    is also outside these bounds, there is a candidate with 1 / median for all joints. If the masses are a guess, the
    bounds are 1/30 and 30, and only the candidate for all joints is returned.

    Args:
        joints: the joints with their fits of gravity.
        undeclared: (n,) True for joints whose torque may have another unit: the mapping states no unit, or mNm.
        loaded: (n,) True for joints that gravity loads enough.
        reference: inertial parameters of the gravity torque with which the torques were compared.
    """
    seen: list[float] = []
    factors = []
    for k, joint in enumerate(joints):
        factor, correlation = joint.report.gravity.factor, abs(joint.report.gravity.correlation or 0.0)
        # The ratio of the logged torque to the URDF's gravity torque is known only if the torque contains much gravity,
        # or is nearly proportional to it.
        share = abs(factor or 0.0) * (joint.report.gravity.relative_deviation or 0.0)
        is_known = (correlation > TUNING.seen and share > TUNING.visible) or correlation > SIGNALS.agreement
        if factor is None or not (is_known and undeclared[k] and loaded[k]):
            continue
        seen.append(factor)
        if reference.is_other_unit(factor) and not reference.is_guess:
            single = np.ones(len(joints))
            single[k] = reference.rounded_factor(1 / factor)
            factors.append(single)
    median = float(np.median(seen)) if seen else 1.0
    if all(undeclared) and reference.is_other_unit(median):
        factors.append(np.full(len(joints), reference.rounded_factor(1 / median)))
    return factors


def find_beyond_drive(joint: JointEvidence) -> str | None:
    """Return a message if torques exceed 20 times the joint's effort limit, so that their unit is wrong; else None."""
    # an effort of 0 in a URDF means that the limit is unknown
    limit, largest = joint.coordinate.effort or 0.0, joint.report.largest("tau")
    # The bound is 20 times the limit: torques in mNm are 1000 times as large as in Nm, and no drive gives 20 times its
    # limit.
    if not 0 < 20.0 * limit < largest:
        return None
    return f"up to {largest:.4g}, {largest / limit:.3g} times what the drive can give"


def find_coarse(joint: JointEvidence) -> str | None:
    """Return a message if the quantisation step of a signal is a large fraction of its range; else None."""
    for name in QUANTITIES:
        # A step is compared with the range: 0.01 Nm are negligible for a shoulder, but may be the whole torque of a
        # wrist.
        step, width = joint.report.steps[name], joint.report.high[name] - joint.report.low[name]
        if step is not None and has_few_levels(step, width):
            return (
                f"{name} has steps of {step:.3g} in a range of {width:.3g}: what is smaller than a step, friction and "
                f"inertia of this joint among it, is not in the log"
            )
    return None


def find_one_way(joint: JointEvidence) -> str | None:
    """Return a message if the joint moves in one direction only; else None.

    Dry friction is then confounded with the load of the joint.
    """
    slower, faster = sorted((-joint.report.low["qd"], joint.report.high["qd"]))
    # The joint moves one way if its largest speed in one direction is below a tenth of its largest speed in the other:
    # the smaller speed may be noise. The check is omitted if logged velocities do not agree with dq/dt.
    if slower >= 0.1 * faster or not (joint.report.velocity_correlation or 0.0) > TUNING.seen:
        return None
    return (
        "moves one way only: dry friction is indistinguishable from gravity and a torque offset; record motion in both "
        "directions"
    )


# `POSITION_CHECKS` need no torques, and therefore also apply to arms under position servos
POSITION_CHECKS = [Check("beyond-position-limit", "warning", find_beyond_limits)]
CHECKS: list[Check[JointEvidence]] = [
    Check("torque-beyond-drive", "error", find_beyond_drive, expected="Nm or N at the joint", do=SAY_UNIT),
    *POSITION_CHECKS,
    Check("beyond-velocity-limit", "warning", partial(find_above, "velocity", "qd")),
    Check("beyond-effort-limit", "warning", partial(find_above, "effort", "tau")),
    Check("coarse", "warning", find_coarse),
    Check("one-way", "warning", find_one_way),
]
