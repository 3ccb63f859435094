"""The finding that a log fits the arm better with other settings, for example with other signs of joints.

The finding names the settings that correct the log. If no setting can correct it, the finding has other advice.
"""

from collections.abc import Sequence

import numpy as np

from spelgen.errors import Diagnostic, LogError
from spelgen.identification.continuous_faults import Gravity, ZeroOffset
from spelgen.identification.hypotheses import HypothesisFit
from spelgen.identification.log_faults import Correction, Fault
from spelgen.identification.log_geometry import GeometryProblem
from spelgen.identification.tuning import GEOMETRY
from spelgen.logs.tuning import SAMPLES

UNEXPLAINED = "torque-unexplained"
WARNINGS = ("torque-scale", ZeroOffset.code, Gravity.code)
RIGHT = "joints, zeros, units and gravity as the URDF and the settings state them"


def geometry_finding(
    unchanged: HypothesisFit, best: HypothesisFit, corrections: Sequence[Correction]
) -> LogError | Diagnostic:
    """Return the finding that the hypothesis of ``best`` explains a log better than the current settings.

    The finding is an error. It is only a warning if an error of the URDF or of the mounting may be the reason: a small
    zero offset, a small tilt, or a moderate factor on the torques.

    Args:
        unchanged: fit of the unchanged log.
        best: fit of the best hypothesis.
        corrections: corrections of the log by the best hypothesis, and by others that fit about equally well.
    """
    faults, correction = best.hypothesis.faults, corrections[0]
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
    do += f"; {' '.join(f'--accept {fault.code}' for fault in faults)} if it is right"
    return LogError(got, element=where, expected=RIGHT, do=do)


def find_unexplained(
    problem: GeometryProblem, unchanged: HypothesisFit, best: HypothesisFit
) -> list[LogError]:
    """Return an error if neither the unchanged log nor a hypothesis about it explains the torques; else [].

    best: fit of the best hypothesis, or `unchanged` if none is significantly better. The joints whose torque residual
    the hypothesis changes count. In the unchanged log, the torque of a joint at rest may be noise only: a joint counts
    in proportion to the variance of its torque or, if it moves and the URDF's torque is as large, by itself.
    """
    errors = best.errors
    weights, limit, wrong = np.abs(errors - unchanged.errors) + 1e-9, GEOMETRY.no_advice, errors > np.inf
    if best is unchanged:
        coarse = problem.thinned(GEOMETRY.coarse_samples)
        signals = coarse.unchanged.signals(coarse.samples)
        tau, speed = signals.tau, signals.motion[1].std(axis=0)
        of_urdf = tau + coarse.residual(coarse.unchanged, coarse.prior_mean)
        weights, limit = tau.var(axis=0) + 1e-30, GEOMETRY.no_torque
        wrong = (errors > limit) & (speed > SAMPLES.moving) & (of_urdf.std(axis=0) > 0.5 * tau.std(axis=0))
    remaining = float(np.average(errors, weights=weights))
    if remaining > limit:
        wrong = errors > GEOMETRY.no_advice
    elif wrong.any():
        remaining = float(errors[wrong].max())
    else:
        return []
    names = [name for name, is_wrong in zip(problem.arm.joint_names, wrong, strict=True) if is_wrong]
    got = (
        "torques that no hypothesis about senses, order, zeros, units and gravity explains: "
        f"{min(remaining, 1.0):.0%} of the variance remains"
    )
    recordings = 1 + np.count_nonzero(np.diff(problem.samples.times) < 0)
    do = "check each recording by itself, and " * bool(recordings > 1) + (
        "check that the columns are the torques of these joints, with their sign and at the times of the positions; "
        f"--accept {UNEXPLAINED} if it is right"
    )
    where = f"joint {', '.join(map(repr, names))}, tau"
    return [LogError(got, element=where, expected="joint torques of a rigid arm with friction", do=do)]


def _place(correction: Correction, fault: Fault) -> str:
    joints = fault.joints(correction)
    if len(joints) == len(correction.arm.joint_names) > 1:
        return "all joints"
    return f"joint {', '.join(map(repr, joints))}"


def _evidence(before: float, after: float) -> str:
    """Return a sentence that compares the squared torque residuals before and after the corrections of a log.

    before, after: mean squared residual, divided by the variance of the torques.
    """
    if after < 0.9 * before:
        return f"the squared torque error of least squares falls from {before:.2%} to {after:.2%} of the variance"
    return "the torque error of least squares remains the same, with plausible positions, masses, inertias and friction"
