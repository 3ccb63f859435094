"""Check logs against the robot: limits, and torques that must move with gravity."""

from __future__ import annotations

from functools import partial
from math import inf, nan
from typing import NamedTuple

from spelgen.arm.arm import Coordinate
from spelgen.labels import UNITS
from spelgen.log_checks.report import MEASURES, JointReport
from spelgen.log_checks.tuning import TUNING
from spelgen.logs.checks import Check
from spelgen.logs.trajectory import QUANTITIES
from spelgen.logs.tuning import SIGNALS

SAY_UNIT = "write 'units: {tau: ...}' or a 'gain' under 'logs' in the robot's YAML; 'Nm' confirms the unit"
TORQUE_ERRORS = ("torque-sense", "torque-unit", "torque-beyond-drive")


class JointEvidence(NamedTuple):
    """Hold a joint, and what all trajectories show of it: the subject of the checks against the robot."""

    coordinate: Coordinate
    report: JointReport

    def limits(self) -> tuple[float, float]:
        """Return the lowest and the highest position, infinite where there is no limit."""
        lower, upper = self.coordinate.lower, self.coordinate.upper
        if self.coordinate.continuous:
            lower = upper = None
        return -inf if lower is None else lower, inf if upper is None else upper

    def gravity_in_torque(self) -> tuple[float, float]:
        """Return factor and correlation of the URDF's gravity in the torque; NaN where it is too small to be seen."""
        fit = self.report.gravity
        # of a joint that gravity hardly loads the factor is chance
        if fit.factor is None or fit.correlation is None or (fit.relative_deviation or 0.0) < TUNING.loaded:
            return nan, nan  # which no comparison takes for odd
        return fit.factor, fit.correlation


def find_beyond_limits(joint: JointEvidence) -> str | None:
    """Find positions, measured or commanded, beyond the limits."""
    findings = []
    (lower, upper), unit = joint.limits(), UNITS[joint.coordinate.kind].position
    for name in ("q", "u"):
        low, high = joint.report.low.get(name, inf), joint.report.high.get(name, -inf)
        # a limit overrun by less is the rounding of a logger
        if low < lower - TUNING.limit_rounding:
            findings.append(f"{name} down to {low:.4g} {unit}, the limit is {lower:.4g}")
        if high > upper + TUNING.limit_rounding:
            findings.append(f"{name} up to {high:.4g} {unit}, the limit is {upper:.4g}")
    return "; ".join(findings) or None


def find_above(limit: str, quantity: str, joint: JointEvidence) -> str | None:
    """Find a quantity above the joint's limit, "velocity" or "effort"."""
    bound: float | None = getattr(joint.coordinate, limit)
    unit = getattr(UNITS[joint.coordinate.kind], MEASURES[quantity])
    largest = joint.report.largest(quantity)
    if not bound or largest <= bound * (1 + TUNING.limit_noise):
        return None
    return f"{limit} up to {largest:.4g} {unit}, the limit is {bound:.4g}"


def find_opposed(seen: float, message: str, joint: JointEvidence) -> str | None:
    """Find torques that move against gravity, beyond a correlation; message: with the factor."""
    factor, correlation = joint.gravity_in_torque()
    return message.format(factor) if correlation < -seen else None


def find_scaled(seen: float, largest: float, message: str, joint: JointEvidence) -> str | None:
    """Find torques that move with gravity, beyond a correlation, by too large or too small a factor.

    message: with the factor and its inverse.
    """
    factor, correlation = joint.gravity_in_torque()
    if correlation > seen and not 1 / largest < factor < largest:
        return message.format(factor, 1 / factor)
    return None


def find_beyond_drive(joint: JointEvidence) -> str | None:
    """Find torques that no drive of the joint's effort limit gives."""
    # URDFs without knowledge of the drive write an effort of 0
    limit, largest = joint.coordinate.effort or 0.0, joint.report.largest("tau")
    if not 0 < TUNING.beyond_drives * limit < largest:
        return None
    return f"up to {largest:.4g}, {largest / limit:.3g} times what the drive can give"


def find_coarse(joint: JointEvidence) -> str | None:
    """Find signals that are quantised to steps of their own size."""
    for name in QUANTITIES:
        # a step alone says little: 0.01 Nm is fine for a shoulder and all there is for a wrist
        step, width = joint.report.steps[name], joint.report.high[name] - joint.report.low[name]
        if step is not None and width < TUNING.levels * step:
            return (
                f"{name} has steps of {step:.3g} in a range of {width:.3g}: what is smaller than a step, friction and "
                f"inertia of this joint among it, is not in the log"
            )
    return None


def find_stop(joint: JointEvidence) -> str | None:
    """Find joints that reach a limit: the torque of a stop is none of the drive's."""
    for limit, extreme in zip(joint.limits(), (joint.report.low["q"], joint.report.high["q"]), strict=True):
        if abs(extreme - limit) <= TUNING.limit_rounding:
            return f"q reaches its limit {limit:.4g}: contact with the stop changes the torque; remove such motion"
    return None


def find_one_way(joint: JointEvidence) -> str | None:
    """Find joints that move one way only: by it dry friction is one number with what loads the joint."""
    slower, faster = sorted((-joint.report.low["qd"], joint.report.high["qd"]))
    # of a velocity that is not dq/dt nothing follows for the motion
    if slower >= TUNING.one_way * faster or not (joint.report.velocity_correlation or 0.0) > TUNING.seen:
        return None
    unit = UNITS[joint.coordinate.kind].velocity
    return (
        f"moves one way only, qd from {joint.report.low['qd']:.3g} to {joint.report.high['qd']:.3g} {unit}: its dry "
        "friction is indistinguishable from gravity and a torque offset; record its motion both ways"
    )


def find_no_gravity(joint: JointEvidence) -> str | None:
    """Find torques without gravity in them."""
    correlation = joint.gravity_in_torque()[1]
    if not abs(correlation) < 1 - TUNING.seen:  # NaN included
        return None
    return (
        f"tau does not move with gravity: their correlation is {correlation:.2g}, while the URDF's gravity torque "
        f"varies {joint.report.gravity.relative_deviation:.2g} times as much as tau; is it compensated in the log?"
    )


# these need no torques: of arms under position servos, too
POSITION_CHECKS = [Check("beyond-position-limit", "warning", find_beyond_limits)]
SENSE = Check(
    "torque-sense", "error",
    partial(find_opposed, SIGNALS.agreement, "torques that move against gravity, {:.3g} times the URDF's"),
    expected="the URDF's sense",
    do="write 'sign: -1' or a negative 'gain' of the joint under 'logs', or the gravity of this mounting",
)  # fmt: skip
CHECKS: list[Check[JointEvidence]] = [
    SENSE,
    # by a factor that only another unit has
    Check(
        "torque-unit", "error",
        partial(
            find_scaled, SIGNALS.agreement, TUNING.impossible_factor,
            "torques that move with {:.3g} times the URDF's gravity torque",
        ),
        expected="Nm or N at the joint", do=SAY_UNIT,
    ),
    Check(
        "torque-beyond-drive", "error", find_beyond_drive, unless=("torque-sense", "torque-unit"),
        expected="Nm or N at the joint", do=SAY_UNIT,
    ),
    *POSITION_CHECKS,
    Check("beyond-velocity-limit", "warning", partial(find_above, "velocity", "qd")),
    Check("beyond-effort-limit", "warning", partial(find_above, "effort", "tau")),
    Check("at-a-stop", "warning", find_stop),
    Check("coarse", "warning", find_coarse),
    Check("one-way", "warning", find_one_way),
    Check("torque-without-gravity", "warning", find_no_gravity, unless=TORQUE_ERRORS),
    Check(
        "torque-against-gravity", "warning",
        partial(
            find_opposed, TUNING.seen,
            "tau moves against gravity: {:.3g} times the URDF's; a sign of tau or q is wrong",
        ),
        unless=TORQUE_ERRORS,
    ),
    # by a factor that errors of inertials do not explain
    Check(
        "torque-scale", "warning",
        partial(
            find_scaled, TUNING.seen, TUNING.unusual_factor,
            "tau moves with {:.3g} times the URDF's gravity torque; check its unit and gain, or let the "
            "gain be found: 'torque: motor', and 'gear: {:.3g}' with 'gain: trained' of this joint",
        ),
        unless=TORQUE_ERRORS,
    ),
]  # fmt: skip
