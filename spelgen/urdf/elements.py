"""Read <link>, <joint> and <transmission> elements of a URDF into data classes; defects are reported, not repaired."""

from collections.abc import Sequence

from lxml import etree

from spelgen.errors import suggestion
from spelgen.urdf.robot import MOVING, Inertial, Mimic, Tensor, Transmission, UrdfJoint, UrdfLink, Vector
from spelgen.urdf.values import MAX_MAGNITUDE, Element, Notes

Limits = tuple[float | None, float | None, float | None, float | None]
"""Limits of a joint: lower, upper [rad, m], effort [Nm, N], velocity [rad/s, m/s]; None for no limit."""

JOINT_TYPES = (*MOVING, "fixed", "floating", "planar")


def read_name(notes: Notes, xml: etree._Element) -> str | None:
    """Return the name of an element; if it has none, add an error to ``notes`` (list of defects) and return None."""
    return Element(notes, xml, f"<{xml.tag}>").name()


def read_link(notes: Notes, xml: etree._Element) -> UrdfLink | None:
    """Return the link of a <link> element; if it has no name, add an error to ``notes`` and return None.

    notes: list of the defects of the file.
    """
    name = read_name(notes, xml)
    if name is None:
        return None
    link = Element(notes, xml, f"link {name!r}")
    return UrdfLink(name, _read_inertial(link.child("inertial")), link.line)


def _read_inertial(inertial: Element) -> Inertial | None:
    if inertial.xml is None:
        return None
    mass_element = inertial.child("mass")
    # Origin and inertia tensor are read first, because an absent <mass> ends this function: errors in them would then
    # not be reported.
    com, rpy = _read_origin(inertial)
    tensor = _read_tensor(inertial)
    if mass_element.xml is None:
        message = "no <mass>: read as no inertial at all"
        inertial.notes.warn(inertial.line, "inertial-without-mass", inertial.where, message)
        return None
    mass = mass_element.number("value")
    if mass is None:
        if mass_element.text("value") is None:
            mass_element.error("no value", "one number [kg]")
        return None
    return Inertial(mass, com, rpy, tensor, inertial.line)


def _read_tensor(inertial: Element) -> Tensor:
    """Return (ixx, ixy, ixz, iyy, iyz, izz) [kg m2] of an <inertial>.

    All are zero if <inertia> is absent, which is a warning, or incomplete, which is an error.
    """
    inertia = inertial.child("inertia")
    if inertia.xml is None and inertial.xml is not None:
        # Some URDFs of vendors contain an unexpanded xacro macro in place of <inertia>: the warning names the macro.
        instead = next((e.tag for e in inertial.xml.iterchildren(etree.Element) if "inertia" in e.tag), None)
        hint = f" (<{instead}> is a xacro macro that was not expanded)" if instead else ""
        message = f"no <inertia>: read as a point mass{hint}"
        inertial.notes.warn(inertial.line, "inertial-without-inertia", inertial.where, message)
        return (0.0,) * 6
    # An absent product of inertia is 0. An absent moment of inertia is an error, because it has no sensible default.
    missing = [key for key in ("ixx", "iyy", "izz") if inertia.text(key) is None]
    if missing:
        inertia.error(f"no {', '.join(missing)}", "ixx, ixy, ixz, iyy, iyz, izz [kg m2]")
        return (0.0,) * 6
    keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    xx, xy, xz, yy, yz, zz = (inertia.number(key) or 0.0 for key in keys)
    return xx, xy, xz, yy, yz, zz


def read_joint(notes: Notes, xml: etree._Element) -> UrdfJoint | None:
    """Return the joint of a <joint> element.

    If its name, type, parent or child is unusable, add errors to ``notes``, the list of defects, and return None.
    """
    name = read_name(notes, xml)
    if name is None:
        return None
    joint = Element(notes, xml, f"joint {name!r}")
    kind = joint.text("type")
    if kind not in JOINT_TYPES:
        got = "no type" if kind is None else f"the type {kind!r}"
        joint.error(got, f"one of {', '.join(JOINT_TYPES)}")
    parent = _read_end(joint, "parent")
    child = _read_end(joint, "child")
    xyz, rpy = _read_origin(joint)
    # Axis, limits and dynamics of a joint without motion, such as a fixed joint, have no effect: their errors become
    # warnings.
    optional = Notes(notes.path)
    motion = joint if kind in MOVING else Element(optional, xml, joint.where)
    axis = _read_axis(motion, kind)
    limits = _read_limits(motion.child("limit"), kind)
    dynamics = motion.child("dynamics")
    damping, friction = dynamics.number("damping") or 0.0, dynamics.number("friction") or 0.0
    mimic = _read_mimic(joint.child("mimic")) if kind in MOVING else None
    # Errors in soft limits become warnings, too, because soft limits restrict motions only.
    safety = Element(optional, xml, joint.where).child("safety_controller")
    low, high = safety.number("soft_lower_limit"), safety.number("soft_upper_limit")
    # Exporters write two zeros for no soft limits.
    soft = (low, high) if low is not None and high is not None and low < high else None
    notes.add_as_warnings(optional)
    if kind not in JOINT_TYPES or parent is None or child is None:
        return None
    pose = xyz, rpy, axis
    return UrdfJoint(name, kind, parent, child, *pose, *limits, damping, friction, mimic, joint.line, soft)


def _read_end(joint: Element, tag: str) -> str | None:
    # A joint with two parents or two children is an error, because the links would not form a tree.
    ends = [] if joint.xml is None else joint.xml.findall(tag)
    link: str | None = ends[0].get("link") if len(ends) == 1 else None
    if not link:
        got = f"{len(ends)} <{tag}> elements" if len(ends) != 1 else f"a <{tag}> without a link"
        joint.error(got, f'one <{tag} link="..."/>')
    return link or None


def _read_origin(parent: Element) -> tuple[Vector, Vector]:
    origin = parent.child("origin")
    # An attribute of <origin> other than xyz and rpy, such as the quaternion of newer URDFs, is an error: ignoring it
    # would give a wrong geometry without a message.
    for key in set(origin.xml.attrib if origin.xml is not None else ()) - {"xyz", "rpy"}:
        origin.error(f"the attribute {key!r}", "xyz [m] and rpy [rad]", "convert the rotation to rpy", key)
    return origin.triple("xyz"), origin.triple("rpy")


def _read_axis(joint: Element, kind: str | None) -> Vector:
    error_count = len(joint.notes.errors)
    axis = joint.child("axis")
    xyz = axis.triple("xyz", (1.0, 0.0, 0.0))  # URDF defines (1, 0, 0) as the default of the joint axis.
    if len(joint.notes.errors) > error_count:
        return xyz
    if axis.xml is not None and axis.text("xyz") is None:
        axis.error("no xyz", "a direction", 'write <axis xyz="..."/>')
    # A joint axis of length zero is an error, because it cannot be normalised.
    elif kind in MOVING and max(map(abs, xyz)) < 1e-9:
        do = f'give the {kind} joint an axis such as "0 0 1"'
        joint.notes.error(axis.line, joint.where, f"the axis {axis.text('xyz')!r}", "a direction", do)
    return xyz


def _read_limits(limit: Element, kind: str | None) -> Limits:
    # An effort or velocity limit of 0 counts as absent, because exporters write 0 for an unknown limit; a negative one
    # means "unlimited" in SDF.
    effort, velocity = (x if x and x > 0 else None for x in (limit.limit("effort"), limit.limit("velocity")))
    if kind == "continuous":
        # URDF defines that lower and upper of a continuous joint have no effect.
        return None, None, effort, velocity
    lower, upper = limit.limit("lower"), limit.limit("upper")
    return (None, None, effort, velocity) if lower == upper == 0 else (lower, upper, effort, velocity)


def _read_mimic(mimic: Element) -> Mimic | None:
    if mimic.xml is None:
        return None
    leader = mimic.text("joint")
    # A missing leader is an error and not a warning, because the position of the mimic joint is then undefined.
    if not leader:
        mimic.error("no joint", 'joint="..." naming the joint to follow')
        return None
    # An absent multiplier of a mimic joint is 1. A multiplier of 0 is kept: it locks the joint at its offset.
    multiplier = mimic.number("multiplier")
    if multiplier is None:
        multiplier = 1.0
    offset = mimic.number("offset") or 0.0
    # A tiny multiplier of a mimic joint is an error like a huge one: its inverse, too, must be within the bound of all
    # numbers in a URDF.
    if multiplier and abs(multiplier) < 1 / MAX_MAGNITUDE:
        expected = f"0, or {1 / MAX_MAGNITUDE:g} at least"
        mimic.error(repr(mimic.text("multiplier")), expected, key="multiplier")
    return Mimic(leader, multiplier, offset)


def read_transmission(notes: Notes, xml: etree._Element, joints: Sequence[str]) -> Transmission:
    """Return the transmission of a <transmission> element (<type>, <joint>, <actuator>) of ROS or ros2_control.

    Unknown joints and unusable numbers are added to ``notes`` as warnings. The unusable numbers are also stored as
    errors in the field ``errors`` of the transmission.

    Args:
        notes: list to which the warnings are added.
        xml: the element.
        joints: names of all joints of the URDF.
    """
    where = f"transmission {xml.get('name', '')!r}"
    # Errors in a transmission become warnings, because most logs contain joint torques, for which no transmission is
    # needed.
    optional = Notes(notes.path)
    driven = []
    for element in xml.findall("joint"):
        joint, joint_name = Element(optional, element, where), element.get("name") or ""
        if joint_name not in joints:
            message = f"names the unknown joint {joint_name!r}; {suggestion(joint_name, joints)}"
            notes.warn(joint.line, "unknown-transmission-joint", where, message)
            continue
        driven.append((joint_name, joint.number_in_text(_reduction_tag(element))))
    actuators = []
    for element in xml.findall("actuator"):
        actuators.append(Element(optional, element, where).number_in_text(_reduction_tag(element)))
    notes.add_as_warnings(optional)
    # The type of a transmission is an element in ROS 1, and an attribute in the files of some exporters.
    kind = (xml.findtext("type") or xml.findtext("plugin") or xml.get("type") or "").strip()
    return Transmission(kind, tuple(driven), tuple(actuators), tuple(optional.errors))


def _reduction_tag(element: etree._Element) -> str:
    """Return the tag of the gear reduction in a <joint> or <actuator> of a transmission; URDFs have two spellings."""
    return "mechanicalReduction" if element.find("mechanical_reduction") is None else "mechanical_reduction"
