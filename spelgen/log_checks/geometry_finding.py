"""The finding that a log fits the arm better with other settings, for example with other signs of joints.

The finding names the settings that correct the log. If no setting can correct it, the finding has other advice.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from spelgen.arm.arm import Chain
from spelgen.errors import Diagnostic, LogError
from spelgen.identification.column_faults import WrongScale
from spelgen.identification.continuous_faults import Gravity, ZeroOffset
from spelgen.identification.hypotheses import Correction, Fault, Hypothesis, HypothesisFit
from spelgen.identification.log_geometry import GeometryProblem
from spelgen.identification.tuning import GEOMETRY
from spelgen.settings.log_mapping import LogMapping

UNEXPLAINED = "torque-unexplained"
WARNINGS = ("torque-scale", ZeroOffset.code, Gravity.code)
RIGHT = "joints, zeros, units and gravity as the URDF and the settings state them"


def stated_hypothesis(arm: Chain, mapping: LogMapping, gears: np.ndarray | float = 1.0) -> Hypothesis:
    """Return the hypothesis that a log has no faults: the signs, scales and offsets of its columns are the mapping's.

    gears: (n,) gear ratios, by which the scales of the torques are multiplied.
    """
    joints = arm.joint_names
    scale = np.array([[mapping.scale(quantity, joint) for joint in joints] for quantity in ("q", "tau")])
    scale[1] *= gears
    offset = np.array([mapping.offset("q", joint) for joint in joints])
    return replace(Hypothesis.unchanged(arm), scale=scale, offset=offset)


def geometry_finding(
    problem: GeometryProblem,
    mapping: LogMapping,
    unchanged: HypothesisFit,
    better: Sequence[HypothesisFit],
    *,
    by_name: bool = False,
) -> LogError | Diagnostic:
    """Return the finding that the hypothesis of lowest cost explains a log better than the current settings.

    The finding is an error. It is only a warning if an error of the URDF or of the mounting may be the reason: a small
    zero offset, a small tilt, or a moderate factor on the torques.

    Args:
        problem: least-squares problem of the logs.
        mapping: mapping of the logs.
        unchanged: fit of the unchanged log.
        better: fits of the best hypothesis, and of others that fit about equally well.
        by_name: see `Correction`.
    """
    best, hypotheses = better[0], [x.hypothesis for x in better]
    corrections = [Correction(problem.arm, mapping, by_name, problem.unchanged, x) for x in hypotheses]
    correction = corrections[0]
    # One fault may cancel the correction of another: torques of all joints reversed, for example, and one once more.
    scaled = [
        x for x in best.hypothesis.faults if not isinstance(x, WrongScale) or x.has(*correction.factors).any()
    ]
    faults = scaled or best.hypothesis.faults
    where = " and ".join(dict.fromkeys(_place(correction, fault) for fault in faults))
    evidence = faults[0].evidence
    if len(faults) > 1 or not evidence:
        evidence = _evidence(unchanged.errors.mean(), best.errors.mean())
    got = f"{' and '.join(fault.text(correction) for fault in faults)} ({evidence})"
    advice = [fault.advice for fault in faults if fault.advice]
    lines = dict.fromkeys(x.lines() for x in corrections)
    do = advice[0] if advice else f"write {'; or '.join(line for line in lines if line)}"
    code = faults[0].minor_code(correction)
    if code and len(faults) == 1:
        return Diagnostic("warning", code, where, None, f"{got}; {do}")
    codes = tuple(fault.code for fault in faults)
    return LogError(got, element=where, expected=RIGHT, do=do, codes=codes)


def find_unexplained(
    problem: GeometryProblem, unchanged: HypothesisFit, best: HypothesisFit | None
) -> Diagnostic | LogError | None:
    """Return the finding that neither the unchanged log nor a hypothesis about it explains the torques, or None.

    The finding is an error if a hypothesis is significantly better than the unchanged log, but has nevertheless a large
    residual at the joints that it affects: the log has a fault, but the hypothesis is not an explanation. Without such
    a hypothesis, the finding is a warning: torques that are mostly noise or friction are unexplained even in a log
    without faults. It is also a warning if these joints are at rest: dry friction carries a part of their load.

    best: fit of the best hypothesis; None if no hypothesis is significantly better.
    """
    if best is None:
        wrong, remaining = _unexplained_joints(problem, unchanged)
    else:
        # Changes of much less than 2 % of the variance are noise. Example: the opposite sense of all torques changes no
        # residual, and all joints then count equally.
        affected = np.abs(best.errors - unchanged.errors) + 0.02
        # A combination of faults is no explanation if a large residual remains in the mean of all joints.
        is_combined = len(best.hypothesis.faults) > 1
        remaining = float(max(np.average(best.errors, weights=affected), is_combined * best.errors.mean()))
        wrong = (best.errors > GEOMETRY.no_advice) & (remaining > GEOMETRY.no_advice)
    if not wrong.any():
        return None
    where = f"joint {', '.join(repr(problem.arm.joint_names[k]) for k in np.flatnonzero(wrong))}, tau"
    got = (
        "torques that no hypothesis about senses, order, zeros, units and gravity explains: "
        f"{min(remaining, 1.0):.0%} of the variance remains"
    )
    do = "check each recording by itself, and " * bool(np.ptp(problem.samples.recording)) + (
        "check that the columns are the torques of these joints, with their sign and at the times of the positions"
    )
    if best is None or not (wrong & problem.unchanged.signals(problem.samples).moving_joints).any():
        return Diagnostic("warning", UNEXPLAINED, where, None, f"{got}; {do}")
    expected = "joint torques of a rigid arm with friction"
    return LogError(got, element=where, expected=expected, do=do, codes=(UNEXPLAINED,))


def _unexplained_joints(problem: GeometryProblem, unchanged: HypothesisFit) -> tuple[np.ndarray, float]:
    """Return the mask (n,) of the joints whose torque the model does not explain, and a relative residual, see below.

    The relative residual of a joint is its squared torque residual divided by the variance of its torque. unchanged:
    fit of the model to the log without corrections. The thresholds in `GEOMETRY` are `no_torque` = 0.6 and `no_advice`
    = 0.2.

    1. If the mean residual is above 0.6, the mask contains the joints with a residual above 0.2, and the second result
       is the mean. It is the mean of all joints, weighted with the variances of their torques, or the mean of the
       moving joints, whichever is larger: the torque of a joint at rest may be only noise.
    2. Otherwise the mask contains the joints that move, have a residual above 0.6, and have a load: the standard
       deviation of the torque predicted with the URDF's parameters exceeds half of the logged torque's. The second
       result is the largest residual of these joints.
    """
    coarse, errors = problem.thinned(GEOMETRY.coarse_samples), unchanged.errors
    signals = coarse.unchanged.signals(coarse.samples)
    of_urdf = coarse.reference_torques(coarse.unchanged)
    is_moving = problem.unchanged.signals(problem.samples).moving_joints
    weights = np.stack([signals.tau.var(axis=0) + 1e-30, is_moving + 1e-30])
    mean = float((weights @ errors / weights.sum(axis=1)).max())
    if mean > GEOMETRY.no_torque:
        return errors > GEOMETRY.no_advice, mean
    is_loaded = of_urdf.std(axis=0) > 0.5 * signals.tau.std(axis=0)
    wrong = (errors > GEOMETRY.no_torque) & is_moving & is_loaded
    return wrong, float(errors[wrong].max(initial=0.0))


def _place(correction: Correction, fault: Fault) -> str:
    joints = fault.joints(correction)
    if len(joints) == len(correction.arm.joint_names) > 1:
        return "all joints"
    return f"joint {', '.join(map(repr, joints))}"


def _evidence(before: float, after: float) -> str:
    """Return a sentence that compares the squared torque residuals before and after the corrections of a log.

    before, after: mean squared residual, divided by the variance of the torques.
    """
    if after < GEOMETRY.lower * before:
        return f"the squared torque error of least squares falls from {before:.2%} to {after:.2%} of the variance"
    return "the torque error of least squares remains the same, with plausible positions, masses, inertias and friction"
