"""A <link>, <joint> or <transmission> element -> its dataclass; defects are reported, not repaired."""

from __future__ import annotations

from collections.abc import Sequence

from lxml import etree

from spelgen.errors import suggestion
from spelgen.urdf.robot import MOVING, Inertial, Mimic, Tensor, Transmission, UrdfJoint, UrdfLink, Vector
from spelgen.urdf.values import (
    MAX_MAGNITUDE,
    Notes,
    first_child,
    note_unexpanded,
    read_limit,
    read_number,
    read_text_number,
    read_triple,
)

Limits = tuple[float | None, float | None, float | None, float | None]
"""Lower, upper, effort, velocity."""

JOINT_TYPES = (*MOVING, "fixed", "floating", "planar")
MAX_NAME = 256
_NO_AXIS: Vector = (1.0, 0.0, 0.0)  # the default of URDF
_NO_LIMITS: Limits = (None, None, None, None)
_DIAGONAL = ("ixx", "iyy", "izz")
_TENSOR = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def read_name(notes: Notes, element: etree._Element) -> str | None:
    """Return the name of an element; None, with an error, if it has none."""
    name = element.get("name")
    if not name or not name.strip():
        got = "no name" if name is None else "an empty name"
        notes.error(element.sourceline, f"<{element.tag}>", got, "a name", 'add name="..."')
        return None
    # names occur in error messages, file names and the emitted module
    if len(name) > MAX_NAME:
        got = f"a name of {len(name)} characters"
        notes.error(element.sourceline, f"<{element.tag}>", got, f"at most {MAX_NAME}")
        return None
    if "${" in name or "$(" in name:
        note_unexpanded(notes, element, f"<{element.tag}> name", name)
        return None
    return str(name)


def read_link(notes: Notes, element: etree._Element) -> UrdfLink | None:
    """Return the link, with its first <inertial>."""
    name = read_name(notes, element)
    if name is None:
        return None
    where = f"link {name!r}"
    # URDF allows one; parsers of ROS use the first
    inertials = element.findall("inertial")
    if len(inertials) > 1:
        message = f"{len(inertials)} <inertial> elements: the first is taken, the others are ignored"
        notes.warn(inertials[1].sourceline, "several-inertials", where, message)
    inertial = _read_inertial(notes, inertials[0], f"{where} inertial") if inertials else None
    return UrdfLink(name, inertial, element.sourceline)


def _read_inertial(notes: Notes, element: etree._Element, where: str) -> Inertial | None:
    mass_element = first_child(notes, element, "mass", where)
    # all parts are read before any is refused, so that all defects are reported
    com, rpy = _read_origin(notes, element, where)
    tensor = _read_tensor(notes, element, where)
    if mass_element is None:
        notes.warn(
            element.sourceline, "inertial-without-mass", where, "no <mass>: read as no inertial at all"
        )
        return None
    mass = read_number(notes, mass_element, "value", f"{where} mass")
    if mass is None:
        if "value" not in mass_element.attrib:
            notes.error(mass_element.sourceline, f"{where} mass", "no value", "one number [kg]")
        return None
    return Inertial(mass, com, rpy, tensor, element.sourceline)


def _read_tensor(notes: Notes, element: etree._Element, where: str) -> Tensor:
    """Return (ixx, ixy, ixz, iyy, iyz, izz) [kg m2]; zeros if <inertia> is absent or, with an error, incomplete."""
    inertia = first_child(notes, element, "inertia", where)
    if inertia is None:
        # URDFs of vendors contain unexpanded macro calls in place of the tensor
        instead = next((e.tag for e in element.iterchildren(etree.Element) if "inertia" in e.tag), None)
        hint = f" (<{instead}> is a xacro macro that was not expanded)" if instead else ""
        message = f"no <inertia>: read as a point mass{hint}"
        notes.warn(element.sourceline, "inertial-without-inertia", where, message)
        return (0.0,) * 6
    # absent products of inertia are 0, moments have no sensible default
    missing = [key for key in _DIAGONAL if key not in inertia.attrib]
    if missing:
        got = f"no {', '.join(missing)}"
        notes.error(inertia.sourceline, f"{where} inertia", got, "ixx, ixy, ixz, iyy, iyz, izz [kg m2]")
        return (0.0,) * 6
    xx, xy, xz, yy, yz, zz = (read_number(notes, inertia, key, f"{where} inertia") or 0.0 for key in _TENSOR)
    return xx, xy, xz, yy, yz, zz


def read_joint(notes: Notes, element: etree._Element) -> UrdfJoint | None:
    """Return the joint; None, with errors, if its name, type, parent or child is unusable."""
    name = read_name(notes, element)
    if name is None:
        return None
    where = f"joint {name!r}"
    kind = element.get("type")
    if kind not in JOINT_TYPES:
        got = "no type" if kind is None else f"the type {kind!r}"
        notes.error(element.sourceline, where, got, f"one of {', '.join(JOINT_TYPES)}")
    parent = _read_end(notes, element, "parent", where)
    child = _read_end(notes, element, "child", where)
    xyz, rpy = _read_origin(notes, element, where)
    # motion attributes of a fixed joint have no meaning: their errors are discarded
    motion = notes if kind in MOVING else Notes(notes.path)
    axis = _read_axis(motion, element, kind, where)
    limits = _read_limit(motion, element, kind, where)
    damping, friction = _read_dynamics(motion, element, where)
    mimic = _read_mimic(notes, element, where) if kind in MOVING else None
    if motion is not notes:
        _warn_instead(notes, motion)
    if kind not in JOINT_TYPES or parent is None or child is None:
        return None
    return UrdfJoint(
        name, kind, parent, child, xyz, rpy, axis, *limits, damping, friction, mimic, element.sourceline
    )


def _read_end(notes: Notes, element: etree._Element, tag: str, where: str) -> str | None:
    # with two parents, the links form no tree
    ends = element.findall(tag)
    link = ends[0].get("link") if ends else None
    if len(ends) != 1 or not link:
        got = f"{len(ends)} <{tag}> elements" if len(ends) != 1 else f"a <{tag}> without a link"
        notes.error(element.sourceline, where, got, f'one <{tag} link="..."/>')
        return None
    return str(link)


def _read_origin(notes: Notes, element: etree._Element, where: str) -> tuple[Vector, Vector]:
    origin = first_child(notes, element, "origin", where)
    if origin is None:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    where = f"{where} origin"
    return read_triple(notes, origin, "xyz", where), read_triple(notes, origin, "rpy", where)


def _read_axis(notes: Notes, element: etree._Element, kind: str | None, where: str) -> Vector:
    axis = first_child(notes, element, "axis", where)
    if axis is None:
        return _NO_AXIS
    error_count = len(notes.errors)
    xyz = read_triple(notes, axis, "xyz", f"{where} axis", _NO_AXIS)
    # an axis of length zero cannot be normalised
    if kind in MOVING and len(notes.errors) == error_count and max(map(abs, xyz)) < 1e-9:
        got = f"the axis {axis.get('xyz')!r}"
        notes.error(
            axis.sourceline, where, got, "a direction", f'give the {kind} joint an axis such as "0 0 1"'
        )
    return xyz


def _read_limit(notes: Notes, element: etree._Element, kind: str | None, where: str) -> Limits:
    limit = first_child(notes, element, "limit", where)
    if limit is None:
        return _NO_LIMITS
    where = f"{where} limit"
    # exporters write 0 for an unknown effort or velocity
    effort, velocity = (read_limit(notes, limit, key, where) or None for key in ("effort", "velocity"))
    if kind == "continuous":
        # lower and upper of a continuous joint have no meaning
        return None, None, effort, velocity
    lower, upper = (read_limit(notes, limit, key, where) for key in ("lower", "upper"))
    if lower == upper == 0:
        lower = upper = None
    return lower, upper, effort, velocity


def _read_dynamics(notes: Notes, element: etree._Element, where: str) -> tuple[float, float]:
    dynamics = first_child(notes, element, "dynamics", where)
    if dynamics is None:
        return 0.0, 0.0
    where = f"{where} dynamics"
    damping = read_number(notes, dynamics, "damping", where)
    return damping or 0.0, read_number(notes, dynamics, "friction", where) or 0.0


def _read_mimic(notes: Notes, element: etree._Element, where: str) -> Mimic | None:
    mimic = first_child(notes, element, "mimic", where)
    if mimic is None:
        return None
    where = f"{where} mimic"
    joint = mimic.get("joint")
    # an error, because a follower without leader has no position
    if not joint:
        notes.error(mimic.sourceline, where, "no joint", 'joint="..." naming the joint to follow')
        return None
    # a multiplier of 0 locks the joint; an absent one means 1
    multiplier = read_number(notes, mimic, "multiplier", where)
    if multiplier is None:
        multiplier = 1.0
    offset = read_number(notes, mimic, "offset", where) or 0.0
    # the inverse of the multiplier is bounded as all numbers of a URDF
    if multiplier and abs(multiplier) < 1 / MAX_MAGNITUDE:
        expected = f"0, or {1 / MAX_MAGNITUDE:g} at least"
        notes.error(mimic.sourceline, f"{where} multiplier", repr(mimic.get("multiplier")), expected)
    return Mimic(joint, multiplier, offset)


def _warn_instead(notes: Notes, optional: Notes) -> None:
    """Add the errors of an optional part of the file to ``notes`` as warnings."""
    notes.diagnostics += optional.diagnostics
    for error in optional.errors:
        message = f"got {error.got}, expected {error.expected}: taken as absent"
        notes.warn(error.line, "unusable-value", str(error.element), message)


def read_transmission(notes: Notes, element: etree._Element, joints: Sequence[str]) -> Transmission:
    """Return the transmission, in the form of ROS (<type>, <joint>, <actuator>).

    Unknown joints and unusable numbers are warnings. The errors are attached to the transmission, for a later step that
    needs it.
    """
    name = element.get("name") or ""
    where = f"transmission {name!r}"
    # most logs contain joint torques, for which no transmission is needed
    optional = Notes(notes.path)
    driven = []
    for joint in element.findall("joint"):
        joint_name = joint.get("name") or ""
        if joint_name not in joints:
            message = f"names the unknown joint {joint_name!r}; {suggestion(joint_name, joints)}"
            notes.warn(joint.sourceline, "unknown-transmission-joint", where, message)
            continue
        reduction = read_text_number(optional, joint, "mechanicalReduction", where)
        driven.append((joint_name, reduction, read_text_number(optional, joint, "offset", where)))
    actuators = []
    for actuator in element.findall("actuator"):
        reduction = read_text_number(optional, actuator, "mechanicalReduction", where)
        actuators.append((actuator.get("name") or "", reduction))
    _warn_instead(notes, optional)
    # ROS 1 uses an element, some exporters an attribute
    kind = (element.findtext("type") or element.get("type") or "").strip()
    errors = tuple(optional.errors)
    return Transmission(name, kind, tuple(driven), tuple(actuators), element.sourceline, errors)
