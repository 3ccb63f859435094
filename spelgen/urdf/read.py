"""Read a URDF file into a `Robot`; all elements are checked, and no defect is repaired silently."""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from lxml import etree

from spelgen.errors import Diagnostic, collect, suggestion
from spelgen.urdf.document import read_document
from spelgen.urdf.elements import read_joint, read_link, read_name, read_transmission
from spelgen.urdf.lint import lint
from spelgen.urdf.robot import Robot, UrdfJoint, UrdfLink
from spelgen.urdf.values import Notes

MAX_LINKS = 2000
_OPEN_LOOPS = "loops are out of URDF's scope: open them and add <mimic>"
Part = TypeVar("Part", UrdfLink, UrdfJoint)


def read_urdf(path: Path) -> Robot:
    """Return the robot in a URDF file, with diagnostics in the order of lines. Meshes are not opened.

    A ``*.xacro`` file is a program, which is executed (see ``xacro_input``); lines then refer to the expanded document.

    Raises UrdfError, or SpelgenErrors with all errors, if the file is missing or does not contain a well-formed tree of
    links and joints.
    """
    document = read_document(path)
    notes = Notes(document.path)
    # A remark states that lines refer to the expanded document: otherwise users would look them up in the xacro file.
    if document.path != path:
        message = f"expanded by xacro: lines are those of the document that `xacro {path.name}` prints"
        notes.diagnostics.append(Diagnostic("info", "expanded-xacro", "robot", None, message))
    for warning in document.warnings:
        notes.warn(None, "xacro-warning", "robot", warning)
    root = document.root
    name = root.get("name") and (read_name(notes, root) or "")
    if not name:
        notes.warn(root.sourceline, "missing-robot-name", "robot", "<robot> has no name: the file's is taken")
    if document.leftovers:
        message = f"{len(document.leftovers)} <xacro:property> elements were left behind by xacro: ignored"
        notes.warn(document.leftovers[0], "unexpanded-xacro", "robot", message)
    links = _read_links(notes, root, document.path != path)
    # Only direct children of <robot> are read: elements for Gazebo, and transmissions, contain <joint> elements too.
    joints = _unique(notes, [read_joint(notes, element) for element in root.findall("joint")])
    _check_ends(notes, links, joints)
    _check_mimics(notes, joints)
    names = [joint.name for joint in joints]
    robot = Robot(
        name=name or notes.path.stem,
        path=path,
        source=document.path,
        digest=hashlib.sha256(document.data).hexdigest(),
        links=tuple(links),
        joints=tuple(joints),
        transmissions=tuple(
            read_transmission(notes, x, names)
            for x in [*root.findall("transmission"), *root.findall("ros2_control/transmission")]
        ),
        root="",
        diagnostics=(),
    )
    # The root link is determined only if there are no errors: the child link of a joint that could not be read would
    # look like a second root.
    if not notes.errors:
        robot = _rooted(notes, root, robot)
    collect(sorted(notes.errors, key=lambda error: error.line or 0))
    return replace(robot, diagnostics=_diagnostics(notes, robot))


def _diagnostics(notes: Notes, robot: Robot) -> tuple[Diagnostic, ...]:
    """Return the diagnostics of reading and of ``lint`` in the order of lines.

    An absent <inertia> is read as a tensor of zeros, with a diagnostic. The diagnostic of ``lint`` about the tensor of
    zeros would repeat it and is omitted.
    """
    absent = {remark.line for remark in notes.diagnostics if remark.code == "inertial-without-inertia"}
    warnings = [x for x in lint(robot) if x.code != "zero-inertia" or x.line not in absent]
    return tuple(sorted([*notes.diagnostics, *warnings], key=lambda remark: remark.line or 0))


def _read_links(notes: Notes, root: etree._Element, is_expanded: bool) -> list[UrdfLink]:
    elements = root.findall("link")
    # The number of links is bounded, because the time of all later steps increases with it. Arms have at most a tenth
    # of the bound.
    if len(elements) > MAX_LINKS:
        notes.error(root.sourceline, "<robot>", f"{len(elements)} links", f"at most {MAX_LINKS}")
        collect(notes.errors)
    if not elements:
        is_xacro = any(uri.endswith("/xacro") for uri in root.nsmap.values())
        do = "this is a xacro file: expand it with the xacro command first" if is_xacro else None
        if is_expanded:
            do = "this xacro file only defines macros or properties: name the xacro file that includes it"
        if root.find("group") is not None:
            do = "this is an SRDF file: name the URDF that it belongs to"
        notes.error(root.sourceline, "<robot>", "no <link>", "a tree of links and joints", do)
        collect(notes.errors)
    elif root.find("joint") is None:
        notes.error(root.sourceline, "<robot>", "no <joint>", "a tree of links and joints")
    return _unique(notes, [read_link(notes, element) for element in elements])


def _unique(notes: Notes, elements: Sequence[Part | None]) -> list[Part]:
    """Return the links or joints that could be read (not None); add an error to ``notes`` if two have the same name."""
    by_name: dict[str, Part] = {}
    for element in elements:
        if element is None:
            continue
        # Of several elements with the same name, only the first is kept: later checks would report errors that the
        # other elements cause.
        first = by_name.setdefault(element.name, element)
        if first is not element:
            kind = "link" if isinstance(element, UrdfLink) else "joint"
            got = f"a second {kind} of that name (the first is in line {first.line})"
            notes.error(element.line, f"{kind} {element.name!r}", got, "unique names", "rename or remove one")
    return list(by_name.values())


def _check_ends(notes: Notes, links: Sequence[UrdfLink], joints: Sequence[UrdfJoint]) -> None:
    """Add errors to ``notes`` about joints with unknown links, and about links that are the child of two joints."""
    names = {link.name: None for link in links}
    above: dict[str, UrdfJoint] = {}
    for joint in joints:
        where = f"joint {joint.name!r}"
        # All ends of all joints are checked: a renamed link causes errors at several joints.
        for role, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in names:
                got = f"no link is named {link!r}"
                notes.error(joint.line, f"{where} {role}", got, do=suggestion(link, names))
        if joint.child in above:
            first = above[joint.child]
            got = f"the link {joint.child!r}, which hangs from {first.name!r} (line {first.line}) already"
            notes.error(joint.line, f"{where} child", got, "one parent per link", _OPEN_LOOPS)
        above.setdefault(joint.child, joint)


def _check_mimics(notes: Notes, joints: Sequence[UrdfJoint]) -> None:
    """Add errors to ``notes`` about mimic joints whose leader is absent or does not move, and cycles of such joints."""
    by_name = {joint.name: joint for joint in joints}
    for joint in joints:
        if joint.mimic is None:
            continue
        where = f"joint {joint.name!r} mimic"
        leader = by_name.get(joint.mimic.joint)
        if leader is None:
            got = f"no joint is named {joint.mimic.joint!r}"
            notes.error(joint.line, where, got, do=suggestion(joint.mimic.joint, by_name))
        # A mimic joint of a fixed joint is an error: it could not move, although its type states that it does.
        elif not leader.moves:
            got = f"the {leader.type} joint {leader.name!r}"
            notes.error(joint.line, where, got, "a revolute, continuous or prismatic joint to follow")
        elif _is_in_cycle(joint, by_name):
            notes.error(joint.line, where, "a circle of mimic joints", "a leader that moves by itself")


def _is_in_cycle(joint: UrdfJoint, by_name: dict[str, UrdfJoint]) -> bool:
    """Return True if ``joint`` is part of a cycle of mimic joints. by_name: {name: joint} of all joints."""
    seen: set[str] = set()
    leader: UrdfJoint | None = joint
    # `seen` contains the joint and its leaders up to here. It ends the loop in a cycle: at the joint if the cycle
    # contains it, otherwise at another leader.
    while leader is not None and leader.mimic is not None and leader.name not in seen:
        seen.add(leader.name)
        leader = by_name.get(leader.mimic.joint)
    return leader is joint and bool(seen)


def _rooted(notes: Notes, root: etree._Element, robot: Robot) -> Robot:
    """Return the robot with its field ``root`` set to the name of the root link.

    If the links do not form a single tree, errors are added to ``notes``. root: the <robot> element.
    """
    children = {joint.child for joint in robot.joints}
    tops = [link for link in robot.links if link.name not in children]
    if len(tops) != 1:
        got, do = "no root link: the joints form a circle", _OPEN_LOOPS
        if tops:
            listed = ", ".join(f"{top.name!r} (line {top.line})" for top in tops[:10])
            got, do = f"{len(tops)} root links: {listed}", "join the trees by a fixed joint"
        notes.error(root.sourceline, "<robot>", got, "one link that is no joint's child", do)
        return robot
    robot = replace(robot, root=tops[0].name)
    # `joints_from_root` always ends: each link has at most one parent here, so that a cycle of links cannot be
    # connected to the root.
    connected = {robot.root, *(joint.child for joint in robot.joints_from_root)}
    for link in robot.links:
        if link.name not in connected:
            got = f"a circle of joints that never meets the root {robot.root!r}"
            notes.error(link.line, f"link {link.name!r}", got, "a tree", _OPEN_LOOPS)
    return robot
