"""Warnings about physically inconsistent values and probable mistakes in a URDF."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from spelgen.errors import Diagnostic
from spelgen.urdf.robot import Inertial, Robot, Tensor, UrdfJoint, UrdfLink

# Tensors are printed with rounding: violations below this fraction are not reported.
_ROUNDING = 1e-6
_UNIT_AXIS = 1e-3


def lint(robot: Robot) -> list[Diagnostic]:
    """Return the diagnostics of inertials, joints, rigid groups and limits, which the reader sorts by line."""
    diagnostics: list[Diagnostic] = []
    for link in robot.links:
        diagnostics += _lint_inertial(link)
    diagnostics += _lint_placeholders(robot)
    for joint in robot.joints:
        diagnostics += _lint_joint(joint)
    return [*diagnostics, *_lint_groups(robot), *_unlimited(robot)]


def _warning(code: str, where: str, line: int, message: str) -> Diagnostic:
    return Diagnostic("warning", code, where, line, message)


def _lint_inertial(link: UrdfLink) -> Iterator[Diagnostic]:
    inertial = link.inertial
    if inertial is None:
        return
    where, line, tensor = f"link {link.name!r} inertial", inertial.line, inertial.tensor
    if inertial.mass < 0:
        yield _warning("negative-mass", where, line, f"the mass is {inertial.mass:g} kg")
    if not any(tensor):
        if inertial.mass > 0:
            yield _warning("zero-inertia", where, line, "the inertia tensor is zero: a point mass")
        return
    # the identity matrix is physically consistent, and is the default of templates
    if tensor == (1.0, 0.0, 0.0, 1.0, 0.0, 1.0):
        yield _warning("placeholder-inertial", where, line, "the tensor is the unit matrix: a placeholder")
    smallest, middle, largest = _principal_moments(inertial)
    if smallest < -_ROUNDING * abs(largest):
        message = (
            f"the inertia tensor is not positive semidefinite: its least principal moment is {smallest:.3g}"
        )
        yield _warning("non-psd-inertia", where, line, message)
    # a principal moment is the sum of two of three nonnegative second moments of mass
    elif smallest + middle < largest * (1 - _ROUNDING):
        inequality = f"{smallest:.3g} + {middle:.3g} < {largest:.3g}"
        message = f"no mass distribution has these principal moments: {inequality}"
        yield _warning("triangle-inequality", where, line, message)


def _principal_moments(inertial: Inertial) -> tuple[float, float, float]:
    tensor = np.zeros((3, 3))
    tensor[np.triu_indices(3)] = inertial.tensor
    smallest, middle, largest = np.linalg.eigvalsh(tensor, UPLO="U").tolist()
    return smallest, middle, largest


def _lint_placeholders(robot: Robot) -> Iterator[Diagnostic]:
    """Warn of placeholders: one tensor repeated on most links was copied, not computed."""
    lines: dict[Tensor, list[int]] = {}
    total = 0
    for link in robot.links:
        if link.inertial is not None and any(link.inertial.tensor):
            lines.setdefault(link.inertial.tensor, []).append(link.inertial.line)
            total += 1
    repeated = max(lines.values(), key=len, default=[])
    # two links may have equal shapes; three equal tensors are copies
    if len(repeated) > total / 2 and len(repeated) >= 3:
        message = f"{len(repeated)} of {total} links have the same inertia tensor: perhaps placeholders"
        yield _warning("placeholder-inertial", "robot", repeated[0], message)


def _lint_joint(joint: UrdfJoint) -> Iterator[Diagnostic]:
    if not joint.moves:
        return
    where = f"joint {joint.name!r}"
    # negative friction adds energy: simulations diverge
    for name, value in (("damping", joint.damping), ("friction", joint.friction)):
        if value < 0:
            message = f"{name} is {value:g}: it would add energy"
            yield _warning("negative-friction", f"{where} dynamics", joint.line, message)
    length = float(np.linalg.norm(joint.axis))
    if abs(length - 1) > _UNIT_AXIS:
        yield _warning(
            "non-unit-axis", f"{where} axis", joint.line, f"its length is {length:.6g}: normalised"
        )
    # not corrected, because either number may be wrong
    if joint.lower is not None and joint.upper is not None and joint.lower > joint.upper:
        message = f"lower {joint.lower:g} is above upper {joint.upper:g}: perhaps the two were swapped"
        yield _warning("lower-above-upper", f"{where} limit", joint.line, message)


def _unlimited(robot: Robot) -> Iterator[Diagnostic]:
    """Name all limits that moving joints do not have, once: every later step treats them as unlimited."""
    lacking: dict[str, list[str]] = {"position": [], "velocity": [], "effort": []}
    joints = [joint for joint in robot.joints if joint.moves and joint.mimic is None]
    for joint in joints:
        if joint.type != "continuous" and (joint.lower is None or joint.upper is None):
            lacking["position"].append(joint.name)
        if joint.velocity is None:
            lacking["velocity"].append(joint.name)
        if joint.effort is None:
            lacking["effort"].append(joint.name)
    texts = []
    for limit, names in lacking.items():
        which = "all joints" if len(names) == len(joints) else ", ".join(names)
        if names:
            texts.append(f"{limit} of {which}")
    if texts:
        message = f"no limits of {'; '.join(texts)}: absent, 0, inf, nan and huge limits mean unlimited"
        yield Diagnostic("info", "unlimited", "robot", joints[0].line, message)


def _lint_groups(robot: Robot) -> Iterator[Diagnostic]:
    """Warn about a moving joint whose rigid group, its child link and all links fixed to it, has no mass."""
    if all(link.inertial is None for link in robot.links):
        yield _warning(
            "missing-inertial", "robot", 1, "no link has an <inertial>: masses and inertias are unknown"
        )
        return
    for joint in robot.joints:
        if not joint.moves:
            continue
        # single links without mass are common; M is singular if a whole rigid group has no mass
        inertials = [link.inertial for link in _rigid_group(robot, joint.child) if link.inertial is not None]
        line = robot.link[joint.child].line
        if not inertials:
            message = (
                f"joint {joint.name!r} moves it, but neither it nor what is fixed to it has an <inertial>"
            )
            yield _warning("missing-inertial", f"link {joint.child!r}", line, message)
        elif not any(inertial.mass for inertial in inertials):
            message = f"joint {joint.name!r} moves it, but it and what is fixed to it have no mass"
            yield _warning("massless-moving-link", f"link {joint.child!r}", line, message)


def _rigid_group(robot: Robot, link: str) -> list[UrdfLink]:
    group, pending = [], [link]
    while pending:
        name = pending.pop()
        group.append(robot.link[name])
        pending.extend(joint.child for joint in robot.joints_below[name] if joint.type == "fixed")
    return group
