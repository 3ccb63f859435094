"""The finding that a log fits the arm better with other settings, for example with other signs of joints.

The finding names the settings that correct the log. If no setting can correct it, the finding has other advice.
"""

from collections.abc import Sequence

from spelgen.errors import Diagnostic, LogError
from spelgen.identification.continuous_faults import Gravity, ZeroOffset
from spelgen.identification.hypotheses import HypothesisFit
from spelgen.identification.log_faults import Correction, Fault

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
