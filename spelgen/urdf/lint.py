"""Warnings about physically inconsistent values and probable mistakes in a URDF."""

from collections.abc import Iterator, Sequence
from math import inf, pi

import numpy as np

from spelgen.errors import Diagnostic
from spelgen.urdf.robot import Inertial, Robot, UrdfJoint

# [1] An inertia tensor is reported if its smallest principal moment is negative, or if the moments violate the triangle
# inequality, by more than this fraction of the largest moment: printed tensors are rounded.
_ROUNDING = 1e-6
# [kg m2] Smaller principal moments count as rounding errors. The moments of a body of 1 mg and 1 mm are larger: 1e-12.
_SMALLEST_INERTIA = 1e-15

_LARGEST_LENGTH = 20.0  # [m] a larger offset of a frame or centre of mass is probably in mm
# [1] Largest plausible distance of a centre of mass from the frame of its link, divided by the sum of the offsets of
# all joints and the travel of prismatic ones. The largest value in 147 URDFs of arms is 4.5 (in robots/rpr.urdf, whose
# values are published). With centres of mass in cm, 98 % of these URDFs would have a value above 5.
_LARGEST_COM = 5.0
# [m] Largest plausible radius of gyration of a link. In 200 URDFs of arms only placeholders have a larger one.
_LARGEST_GYRATION = 3.0
# [kg/m^3] Largest plausible density of a sphere with the mass and the largest radius of gyration of a link. Metals are
# below 2.3e4; of 1,296 links in 200 URDFs only a placeholder, 1 kg with a radius of 2 mm, exceeds 2e5. With a mass in
# grams and an inertia in kg m^2, the radius of gyration is smaller by sqrt(1000), so the density is 1000^2.5 = 3e7
# times as large.
_LARGEST_DENSITY = 1e6

Finding = tuple[str, str, int, str]
"""Code, place, line and message of a warning."""


def lint(robot: Robot) -> list[Diagnostic]:
    """Return warnings about inertials, joints and links of a robot, and a remark on absent limits, in any order."""
    extent = sum(float(np.linalg.norm(joint.xyz)) + _travel(joint) for joint in robot.joints)
    farthest = min(_LARGEST_COM * extent or np.inf, _LARGEST_LENGTH)
    findings = [
        finding
        for link in robot.links
        if link.inertial
        for finding in _lint_inertial(link.name, link.inertial, farthest)
    ]
    findings += _lint_placeholders([link.inertial for link in robot.links if link.inertial])
    moving = [joint for joint in robot.joints if joint.moves]
    findings += [finding for joint in moving for finding in _lint_joint(joint)]
    findings += [finding for joint in robot.joints for finding in _lint_units(joint)]
    findings += _lint_groups(robot, moving)
    warnings = [Diagnostic("warning", code, where, line, message) for code, where, line, message in findings]
    return [*warnings, *_unlimited([joint for joint in moving if joint.mimic is None])]


def _travel(joint: UrdfJoint) -> float:
    """Return the largest distance [m] that a prismatic joint moves from its zero; 0 for other joints or no limits."""
    limits = [abs(x) for x in (joint.lower, joint.upper) if x is not None and np.isfinite(x)]
    return max(limits, default=0.0) if joint.type == "prismatic" else 0.0


def _lint_inertial(link: str, inertial: Inertial, farthest: float) -> Iterator[Finding]:
    """Yield warnings about the inertial of a link. farthest: largest plausible coordinate of a centre of mass [m]."""
    where, line, tensor = f"link {link!r} inertial", inertial.line, inertial.tensor
    if inertial.mass < 0:
        yield "negative-mass", where, line, f"the mass is {inertial.mass:g} kg"
    if max(map(abs, tensor)) < _SMALLEST_INERTIA:
        if inertial.mass > 0:
            yield "zero-inertia", where, line, "the inertia tensor is zero: a point mass"
        return
    # The identity matrix is a physically consistent inertia tensor, but it is the default of templates and no real
    # inertia.
    if tensor == (1.0, 0.0, 0.0, 1.0, 0.0, 1.0):
        yield "placeholder-inertial", where, line, "the tensor is the unit matrix: a placeholder"
    if max(map(abs, inertial.com)) > farthest:
        message = (
            f"a centre of mass at {max(map(abs, inertial.com)):g} m, of an arm with joints within "
            f"{farthest / _LARGEST_COM:.3g} m: perhaps centimetres or millimetres"
        )
        yield "millimetres", where, line, message
    matrix = np.zeros((3, 3))
    matrix[np.triu_indices(3)] = tensor
    smallest, middle, largest = np.linalg.eigvalsh(matrix, UPLO="U").tolist()
    gyration = float(np.sqrt(max(largest, 0.0) / inertial.mass)) if inertial.mass > 0 else 0.0
    if gyration > _LARGEST_GYRATION:
        message = (
            f"a radius of gyration of {gyration:.3g} m: perhaps the tensor is in kg mm2, or the mass in g"
        )
        yield "millimetres", where, line, message
    # A solid sphere of radius r has the radius of gyration r sqrt(2/5).
    volume = 4 / 3 * pi * (gyration * np.sqrt(5 / 2)) ** 3
    if inertial.mass > _LARGEST_DENSITY * volume > 0:
        message = (
            f"a mass of {inertial.mass:.3g} kg with a radius of gyration of {1e3 * gyration:.3g} mm is denser than any "
            "metal: perhaps the mass is in g, or the tensor is a placeholder"
        )
        yield "density", where, line, message
    if smallest < -_ROUNDING * abs(largest):
        fault = "the inertia tensor is not positive semidefinite"
        yield "non-psd-inertia", where, line, f"{fault}: its least principal moment is {smallest:.3g}"
    # Triangle inequality: each principal moment is the sum of two of three nonnegative second moments of mass, so that
    # none exceeds the sum of the other two.
    elif smallest + middle < largest * (1 - _ROUNDING):
        sides = [x if abs(x) > _ROUNDING * largest else 0.0 for x in (smallest, middle)]
        inequality = f"{sides[0]:.3g} + {sides[1]:.3g} < {largest:.3g}"
        message = f"no mass distribution has these principal moments: {inequality}"
        yield "triangle-inequality", where, line, message


def _lint_placeholders(inertials: Sequence[Inertial]) -> Iterator[Finding]:
    """Yield a warning if most links have the same inertia tensor, or the same mass: it was probably copied."""
    tensors = [(x.tensor, x.line) for x in inertials if any(x.tensor)]
    masses = [(x.mass, x.line) for x in inertials if x.mass > 0]
    for quantity, stated in (("inertia tensor", tensors), ("mass", masses)):
        lines: dict[object, list[int]] = {}
        for value, line in stated:
            lines.setdefault(value, []).append(line)
        repeated = max(lines.values(), key=len, default=[])
        # Two equal values are no evidence of a copy, because two links may have the same shape.
        if len(repeated) > len(stated) / 2 and len(repeated) >= 3:
            message = f"{len(repeated)} of {len(stated)} links have the same {quantity}: perhaps placeholders"
            yield "placeholder-inertial", "robot", repeated[0], message
            return


def _lint_joint(joint: UrdfJoint) -> Iterator[Finding]:
    where, line = f"joint {joint.name!r}", joint.line
    # Negative friction adds energy, so that simulations diverge.
    for name, value in (("damping", joint.damping), ("friction", joint.friction)):
        if value < 0:
            yield "negative-friction", f"{where} dynamics", line, f"{name} is {value:g}: it would add energy"
    if joint.effort is not None and joint.friction > joint.effort:
        message = f"a friction of {joint.friction:g} above the effort limit {joint.effort:g}: the drive cannot move it"
        yield "friction-above-effort", f"{where} dynamics", line, message
    length = float(np.linalg.norm(joint.axis))
    if abs(length - 1) > 1e-3:
        yield "non-unit-axis", f"{where} axis", line, f"its length is {length:.6g}: normalised"
    # A lower limit above the upper limit is reported and not corrected: the limits may be swapped, or one of the
    # numbers may be wrong.
    if joint.lower is not None and joint.upper is not None and joint.lower >= joint.upper:
        message = f"lower {joint.lower:g} is above upper {joint.upper:g}: perhaps the two were swapped"
        if joint.lower == joint.upper:
            message = f"lower and upper are both {joint.lower:g}: it cannot move, perhaps its type is fixed"
        yield "lower-above-upper", f"{where} limit", line, message


def _lint_units(joint: UrdfJoint) -> Iterator[Finding]:
    """Yield warnings about angles that are probably in degrees, and lengths that are probably in millimetres."""
    limits = [abs(x) for x in (joint.lower, joint.upper) if x is not None and joint.type == "revolute"]
    sizes = (
        ("degrees", "origin", "rpy", max(map(abs, joint.rpy)), "rad", 2 * pi + 0.01, 2.0),
        ("degrees", "limit", "a position", max(limits, default=0.0), "rad", 8 * pi, 2 * pi),
        ("millimetres", "origin", "xyz", max(map(abs, joint.xyz)), "m", _LARGEST_LENGTH, inf),
    )
    # Angles in radians are rarely whole numbers. In the URDFs of ../shared, none of the angles of an <origin> above 2
    # rad and none of the position limits between 2 pi and 1000 is a whole number.
    for code, element, quantity, size, unit, largest, largest_whole in sizes:
        if size > largest or (size >= largest_whole and size.is_integer()):
            message = f"{quantity} of {size:g} {unit}: perhaps {code}"
            yield code, f"joint {joint.name!r} {element}", joint.line, message


def _unlimited(joints: Sequence[UrdfJoint]) -> Iterator[Diagnostic]:
    """Yield one remark that lists the moving joints without a limit of position, velocity or effort, if there are any.

    Continuous joints need no limit of position.
    """
    lacking = {
        "position": [x.name for x in joints if x.type != "continuous" and None in (x.lower, x.upper)],
        "velocity": [x.name for x in joints if x.velocity is None],
        "effort": [x.name for x in joints if x.effort is None],
    }
    texts = []
    for limit, names in lacking.items():
        # Most URDFs specify a limit for all joints or for none: the words "all joints" are then shorter than all names.
        which = "all joints" if len(names) == len(joints) else ", ".join(names)
        if names:
            texts.append(f"{limit} of {which}")
    if texts:
        message = f"no limits of {'; '.join(texts)}: absent, 0, inf, nan and huge limits mean unlimited"
        yield Diagnostic("info", "unlimited", "robot", joints[0].line, message)


def _lint_groups(robot: Robot, moving: Sequence[UrdfJoint]) -> Iterator[Finding]:
    """Yield a warning for each moving joint whose rigid group has no mass.

    The rigid group is the child link of the joint and all links that fixed joints connect to it.
    """
    if all(link.inertial is None for link in robot.links):
        yield "missing-inertial", "robot", 1, "no link has an <inertial>: masses and inertias are unknown"
        return
    for joint in moving:
        # The mass of rigid groups is tested and not the mass of links: single links without mass are common, but M is
        # singular if a whole rigid group has no mass.
        group = [joint.child]
        for name in group:
            group += [below.child for below in robot.joints_below[name] if below.type == "fixed"]
        inertials = [inertial for name in group if (inertial := robot.link[name].inertial)]
        where, line = f"link {joint.child!r}", robot.link[joint.child].line
        if not inertials:
            message = (
                f"joint {joint.name!r} moves it, but neither it nor a link fixed to it has an <inertial>"
            )
            yield "missing-inertial", where, line, message
        elif not any(inertial.mass for inertial in inertials):
            message = f"joint {joint.name!r} moves it, but it and the links fixed to it have no mass"
            yield "massless-moving-link", where, line, message
