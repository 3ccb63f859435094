"""One <link>, <joint> or <transmission> element -> its dataclass, with every defect noted and none repaired.

The numbers are read here and not through yourdfpy: each must be checked as text first (count, length,
finiteness, line), and what yourdfpy adds after that is to fill in absent inertia with 1.0, turn origins into
matrices and lose mechanical reductions. The tests hold the two readings against each other where yourdfpy is
faithful.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from math import isfinite
from pathlib import Path

from lxml import etree

from spelgen.errors import Diagnostic, UrdfError, suggestion
from spelgen.robot import MOVING, Inertial, Joint, Link, Mimic, Tensor, Transmission, Vector

JOINT_TYPES = (*MOVING, "fixed", "floating", "planar")
MAX_NAME = 256
MAX_NUMBER_TEXT = 64
MAX_MAGNITUDE = 1e12
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)
_DIAGONAL = ("ixx", "iyy", "izz")
_TENSOR = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_COUNTS = {1: "one number", 3: "three numbers"}


class Notes:
    """What is gathered while a file is read: errors, told together at the end, and diagnostics."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.errors: list[UrdfError] = []
        self.diagnostics: list[Diagnostic] = []

    def error(
        self, line: int | None, element: str, got: str, expected: str | None = None, do: str | None = None
    ) -> None:
        """Note an error."""
        self.errors.append(
            UrdfError(got, file=self.path, line=line, element=element, expected=expected, do=do)
        )

    def warn(self, line: int | None, code: str, where: str, message: str) -> None:
        """Note a warning."""
        self.diagnostics.append(Diagnostic("warning", code, where, line, message))


def read_name(notes: Notes, element: etree._Element) -> str | None:
    """The element's usable name; None, with an error noted, where it has none."""
    name = element.get("name")
    if not name or not name.strip():
        got = "no name" if name is None else "an empty name"
        notes.error(element.sourceline, f"<{element.tag}>", got, "a name", 'add name="..."')
        return None
    if len(name) > MAX_NAME:
        got = f"a name of {len(name)} characters"
        notes.error(element.sourceline, f"<{element.tag}>", got, f"at most {MAX_NAME}")
        return None
    if "${" in name or "$(" in name:
        _unexpanded(notes, element, f"<{element.tag}> name", name)
        return None
    return name


def read_link(notes: Notes, element: etree._Element) -> Link | None:
    """The link; only its first <inertial> counts."""
    name = read_name(notes, element)
    if name is None:
        return None
    where = f"link {name!r}"
    inertials = element.findall("inertial")
    if len(inertials) > 1:
        message = f"{len(inertials)} <inertial> elements: the first is taken, the others are ignored"
        notes.warn(inertials[1].sourceline, "several-inertials", where, message)
    inertial = _read_inertial(notes, inertials[0], f"{where} inertial") if inertials else None
    return Link(name, inertial, element.sourceline)


def _read_inertial(notes: Notes, element: etree._Element, where: str) -> Inertial | None:
    mass_element = _child(notes, element, "mass", where)
    com, rpy = _read_origin(notes, element, where)
    tensor = _read_tensor(notes, element, where)
    if mass_element is None:
        notes.warn(
            element.sourceline, "inertial-without-mass", where, "no <mass>: read as no inertial at all"
        )
        return None
    mass = _number(notes, mass_element, "value", f"{where} mass")
    if mass is None:
        if "value" not in mass_element.attrib:
            notes.error(mass_element.sourceline, f"{where} mass", "no value", "one number [kg]")
        return None
    return Inertial(mass, com, rpy, tensor, element.sourceline)


def _read_tensor(notes: Notes, element: etree._Element, where: str) -> Tensor:
    inertia = _child(notes, element, "inertia", where)
    if inertia is None:
        instead = next((e.tag for e in element.iterchildren(etree.Element) if "inertia" in e.tag), None)
        hint = f" (<{instead}> is a xacro macro that was not expanded)" if instead else ""
        message = f"no <inertia>: read as a point mass{hint}"
        notes.warn(element.sourceline, "inertial-without-inertia", where, message)
        return (0.0,) * 6
    missing = [key for key in _DIAGONAL if key not in inertia.attrib]
    if missing:
        got = f"no {', '.join(missing)}"
        notes.error(inertia.sourceline, f"{where} inertia", got, "ixx, ixy, ixz, iyy, iyz, izz [kg m2]")
        return (0.0,) * 6
    xx, xy, xz, yy, yz, zz = (_number(notes, inertia, key, f"{where} inertia") or 0.0 for key in _TENSOR)
    return xx, xy, xz, yy, yz, zz


def read_joint(notes: Notes, element: etree._Element) -> Joint | None:
    """The joint; None, with the errors noted, where it cannot be one."""
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
    axis = _read_axis(notes, element, kind, where)
    limits = _read_limit(notes, element, kind, where)
    damping, friction = _read_dynamics(notes, element, where)
    mimic = _read_mimic(notes, element, where)
    if kind not in JOINT_TYPES or parent is None or child is None:
        return None
    return Joint(
        name, kind, parent, child, xyz, rpy, axis, *limits, damping, friction, mimic, element.sourceline
    )


def _read_end(notes: Notes, element: etree._Element, tag: str, where: str) -> str | None:
    ends = element.findall(tag)
    link = ends[0].get("link") if ends else None
    if len(ends) != 1 or not link:
        got = f"{len(ends)} <{tag}> elements" if len(ends) != 1 else f"a <{tag}> without a link"
        notes.error(element.sourceline, where, got, f'one <{tag} link="..."/>')
        return None
    return link


def _read_origin(notes: Notes, element: etree._Element, where: str) -> tuple[Vector, Vector]:
    origin = _child(notes, element, "origin", where)
    if origin is None:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    return _triple(notes, origin, "xyz", f"{where} origin"), _triple(notes, origin, "rpy", f"{where} origin")


def _read_axis(notes: Notes, element: etree._Element, kind: str | None, where: str) -> Vector:
    axis = _child(notes, element, "axis", where)
    default = (1.0, 0.0, 0.0)
    if axis is None:
        return default
    before = len(notes.errors)
    xyz = _triple(notes, axis, "xyz", f"{where} axis", default)
    if kind in MOVING and len(notes.errors) == before and max(map(abs, xyz)) < 1e-9:
        got = f"the axis {axis.get('xyz')!r}"
        notes.error(
            axis.sourceline, where, got, "a direction", f'give the {kind} joint an axis such as "0 0 1"'
        )
    return xyz


def _read_limit(
    notes: Notes, element: etree._Element, kind: str | None, where: str
) -> tuple[float | None, float | None, float | None, float | None]:
    limit = _child(notes, element, "limit", where)
    wanted = {
        "revolute": ("lower", "upper", "effort", "velocity"),
        "prismatic": ("lower", "upper", "effort", "velocity"),
        "continuous": ("effort", "velocity") if limit is not None else (),
    }.get(kind or "", ())
    missing = [key for key in wanted if limit is None or key not in limit.attrib]
    if missing:
        told = "no <limit>" if limit is None else f"<limit> lacks {', '.join(missing)}"
        line = element.sourceline if limit is None else limit.sourceline
        notes.warn(line, "incomplete-limit", where, f"{told}: read as unlimited")
    if limit is None:
        return None, None, None, None
    told_where = f"{where} limit"
    lower, upper = (
        _number(notes, limit, key, told_where, bounded=False) if kind != "continuous" else None
        for key in ("lower", "upper")
    )
    effort, velocity = (
        _number(notes, limit, key, told_where, bounded=False) for key in ("effort", "velocity")
    )
    return lower, upper, effort, velocity


def _read_dynamics(notes: Notes, element: etree._Element, where: str) -> tuple[float, float]:
    dynamics = _child(notes, element, "dynamics", where)
    if dynamics is None:
        return 0.0, 0.0
    damping, friction = (
        _number(notes, dynamics, key, f"{where} dynamics") or 0.0 for key in ("damping", "friction")
    )
    return damping, friction


def _read_mimic(notes: Notes, element: etree._Element, where: str) -> Mimic | None:
    mimic = _child(notes, element, "mimic", where)
    if mimic is None:
        return None
    where = f"{where} mimic"
    joint = mimic.get("joint")
    if not joint:
        notes.error(mimic.sourceline, where, "no joint", 'joint="..." naming the joint to follow')
        return None
    multiplier, offset = _number(notes, mimic, "multiplier", where), _number(notes, mimic, "offset", where)
    return Mimic(joint, 1.0 if multiplier is None else multiplier, 0.0 if offset is None else offset)


def read_transmission(notes: Notes, element: etree._Element, joints: Sequence[str]) -> Transmission:
    """The transmission, in the ROS form (<type>, <joint>, <actuator>); unknown joints are said."""
    name = element.get("name") or ""
    where = f"transmission {name!r}"
    driven = []
    for joint in element.findall("joint"):
        joint_name = joint.get("name") or ""
        if joint_name not in joints:
            message = f"names the unknown joint {joint_name!r}; {suggestion(joint_name, joints)}"
            notes.warn(joint.sourceline, "unknown-transmission-joint", where, message)
            continue
        reduction = _text_number(notes, joint, "mechanicalReduction", where)
        driven.append((joint_name, reduction, _text_number(notes, joint, "offset", where)))
    actuators = tuple(
        (actuator.get("name") or "", _text_number(notes, actuator, "mechanicalReduction", where))
        for actuator in element.findall("actuator")
    )
    kind = (element.findtext("type") or element.get("type") or "").strip()
    return Transmission(name, kind, tuple(driven), actuators, element.sourceline)


def _child(notes: Notes, element: etree._Element, tag: str, where: str) -> etree._Element | None:
    """The first child of that tag; repeated ones are said."""
    children = element.findall(tag)
    if len(children) > 1:
        message = f"{len(children)} <{tag}> elements: the first is taken, the others are ignored"
        notes.warn(children[1].sourceline, "repeated-element", where, message)
    return children[0] if children else None


def _triple(
    notes: Notes, element: etree._Element, key: str, where: str, default: Vector = (0.0, 0.0, 0.0)
) -> Vector:
    text = element.get(key)
    if text is None:
        return default
    values = _parsed(notes, element, text, 3, f"{where} {key}", bounded=True)
    return default if values is None else (values[0], values[1], values[2])


def _number(
    notes: Notes, element: etree._Element, key: str, where: str, *, bounded: bool = True
) -> float | None:
    text = element.get(key)
    values = None if text is None else _parsed(notes, element, text, 1, f"{where} {key}", bounded)
    return None if values is None else values[0]


def _text_number(notes: Notes, element: etree._Element, tag: str, where: str) -> float | None:
    child = element.find(tag)
    if child is None or not (child.text or "").strip():
        return None
    values = _parsed(notes, child, child.text or "", 1, f"{where} {tag}", bounded=True)
    return None if values is None else values[0]


def _parsed(
    notes: Notes, element: etree._Element, text: str, count: int, where: str, bounded: bool
) -> list[float] | None:
    """``count`` finite numbers; None, with an error noted, for anything else.

    Only what becomes exact geometry is bounded in size: limits may be as large as a float to say "none".
    """
    if "${" in text or "$(" in text:
        _unexpanded(notes, element, where, text)
        return None
    words = text.split()
    expected = _COUNTS[count]
    if len(words) != count:
        shown = text if len(text) <= MAX_NUMBER_TEXT else f"{text[:MAX_NUMBER_TEXT]}..."
        notes.error(element.sourceline, where, f"{len(words)} numbers ({shown!r})", expected)
        return None
    for word in words:
        if len(word) > MAX_NUMBER_TEXT:
            got = f"a number of {len(word)} characters"
            notes.error(element.sourceline, where, got, f"at most {MAX_NUMBER_TEXT}")
            return None
        if not _NUMBER.fullmatch(word):
            hint = "separate numbers by spaces" if "," in word else None
            notes.error(element.sourceline, where, repr(word), f"{expected} in decimal notation", hint)
            return None
    values = [float(word) for word in words]
    if not all(isfinite(value) and (not bounded or abs(value) <= MAX_MAGNITUDE) for value in values):
        bound = f"within +-{MAX_MAGNITUDE:g}" if bounded else "within the range of a float"
        notes.error(element.sourceline, where, repr(text), f"{expected} {bound}")
        return None
    return values


def _unexpanded(notes: Notes, element: etree._Element, where: str, text: str) -> None:
    do = "expand the file with the xacro command first"
    notes.error(
        element.sourceline, where, f"the xacro expression {text[:MAX_NUMBER_TEXT]!r}", "a plain value", do
    )
