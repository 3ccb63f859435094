"""Rigid bodies -> a URDF and the settings beside it: the arm's own files with other numbers in them."""

from __future__ import annotations

import numpy as np
import yaml
from lxml import etree

from spelgen.arm.angle_rounding import AngleRounding
from spelgen.arm.rational import alignment
from spelgen.dynamics.rigid_bodies import about_center
from spelgen.exporting.rigid_body_projection import RigidBodyProjection
from spelgen.urdf.document import urdf_bytes
from spelgen.urdf.robot import Robot


def urdf_text(projection: RigidBodyProjection) -> bytes:
    """Return the arm's URDF with these inertials and friction.

    A link that a joint moves gets all that moves with it; the links it carries by fixed or locked joints lose
    their inertials to it.
    """
    robot = projection.arm.robot
    arm = projection.arm.arm
    # a robot's file may come from anywhere
    parser = etree.XMLParser(resolve_entities=False, no_network=True)
    root = etree.fromstring(urdf_bytes(robot.path), parser)
    links = {element.get("name"): element for element in root.findall("link")}
    joints = {element.get("name"): element for element in root.findall("joint")}
    moved = {robot.joint[body.name].child for body in arm.bodies}
    for name in _carried_links(robot, moved):
        _remove(links[name], "inertial")
    rounding = AngleRounding(projection.arm.angle_tolerance)
    for body, inertia in zip(arm.bodies, projection.inertias, strict=True):
        joint = robot.joint[body.name]
        _set_inertial(links[joint.child], inertia, alignment(rounding.axis(joint)))
    # a URDF has one Coulomb friction for both directions
    coulomb = (projection.forward - projection.backward) / 2
    for index, coordinate in enumerate(arm.coordinates):
        element = joints[coordinate.name]
        _remove(element, "dynamics")
        values = {"damping": _number(projection.viscous[index]), "friction": _number(coulomb[index])}
        etree.SubElement(element, "dynamics", values)
    text: bytes = etree.tostring(root, xml_declaration=True, encoding="utf-8")
    return text + b"\n"


def settings_text(projection: RigidBodyProjection) -> str:
    """Return the settings beside the arm's URDF with these drives and friction, in both directions."""
    path = projection.arm.robot.path.with_suffix(".yaml")
    content: dict[str, dict[str, dict[str, object]]] = {}
    if path.exists():
        content = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    joints = content.setdefault("joints", {})
    for index, coordinate in enumerate(projection.arm.arm.coordinates):
        # settings have the rotor's own inertia, the model that of the joint's side
        gear = projection.arm.settings.joint(coordinate.name).gear
        joint = joints.setdefault(coordinate.name, {})
        joint["rotor_inertia"] = rounded(projection.armature[index] / gear**2)
        joint["viscous"] = rounded(projection.viscous[index])
        joint["coulomb"] = [rounded(projection.forward[index]), rounded(projection.backward[index])]
    text: str = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
    return text


def rounded(value: float) -> float:
    """Return a number of twelve digits: what a person may read, far beyond what a fit finds."""
    return float(_number(value))


def _carried_links(robot: Robot, moved: set[str]) -> list[str]:
    """Return the links with an inertial that move with another link."""
    carried = []
    for link in robot.links:
        if link.inertial is None or link.name in moved:
            continue
        above = {joint.child for joint in robot.path_to(link.name)}
        # links before the first joint stay as they are
        if above & moved:
            carried.append(link.name)
    return carried


def _set_inertial(link: etree._Element, inertia: np.ndarray, rotation: np.ndarray) -> None:
    """Set a link's inertial; ``rotation`` takes +z, the joint's axis in its own frame, to the axis in the link's."""
    _remove(link, "inertial")
    mass, center, tensor = about_center(inertia)
    center = rotation @ center
    tensor = rotation @ tensor @ rotation.T
    inertial = etree.Element("inertial")
    etree.SubElement(inertial, "origin", xyz=" ".join(map(_number, center)), rpy="0 0 0")
    etree.SubElement(inertial, "mass", value=_number(mass))
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    moments = list(map(_number, tensor[np.triu_indices(3)]))
    etree.SubElement(inertial, "inertia", dict(zip(names, moments, strict=True)))
    # first, as most URDFs have it
    link.insert(0, inertial)


def _remove(element: etree._Element, tag: str) -> None:
    for child in element.findall(tag):
        element.remove(child)


def _number(value: float) -> str:
    return f"{value:.12g}"
