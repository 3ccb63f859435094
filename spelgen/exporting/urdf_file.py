"""Rigid bodies -> a URDF and the settings beside it: the arm's own files with other numbers in them."""

from __future__ import annotations

import numpy as np
import yaml
from lxml import etree

from spelgen.arm.angle_rounding import AngleRounding
from spelgen.arm.rational import alignment
from spelgen.exporting.rigid_body_projection import RigidBodyProjection
from spelgen.urdf.document import urdf_bytes
from spelgen.urdf.robot import Robot

TEN = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def urdf_text(projection: RigidBodyProjection) -> bytes:
    """The arm's URDF with these inertials and friction.

    A link that a joint moves gets all that moves with it; the links it carries by fixed or locked joints lose
    their inertials to it.
    """
    robot, arm = projection.arm.robot, projection.arm.arm
    parser = etree.XMLParser(resolve_entities=False, no_network=True)
    root = etree.fromstring(urdf_bytes(robot.path), parser)
    links = {element.get("name"): element for element in root.findall("link")}
    joints = {element.get("name"): element for element in root.findall("joint")}
    moved = {robot.joint[body.name].child for body in arm.bodies}
    for name in _carried(robot, moved):
        for element in links[name].findall("inertial"):
            links[name].remove(element)
    rounding = AngleRounding(projection.arm.angle_tolerance)
    for body, ten in zip(arm.bodies, projection.inertias, strict=True):
        joint = robot.joint[body.name]
        _set_inertial(links[joint.child], _in_link(ten, alignment(rounding.axis(joint))))
    for index, coordinate in enumerate(arm.coordinates):
        mean = (projection.forward[index] - projection.backward[index]) / 2
        element = joints[coordinate.name]
        for old in element.findall("dynamics"):
            element.remove(old)
        values = {"damping": _number(projection.viscous[index]), "friction": _number(mean)}
        etree.SubElement(element, "dynamics", values)
    return etree.tostring(root, xml_declaration=True, encoding="utf-8") + b"\n"


def settings_text(projection: RigidBodyProjection) -> str:
    """The settings beside the arm's URDF with these drives and friction, in both directions."""
    beside = projection.arm.robot.path.with_suffix(".yaml")
    content = (yaml.safe_load(beside.read_text(encoding="utf-8")) if beside.exists() else None) or {}
    joints = content.setdefault("joints", {})
    for index, coordinate in enumerate(projection.arm.arm.coordinates):
        joint = joints.setdefault(coordinate.name, {})
        gear = projection.arm.settings.joint(coordinate.name).gear
        joint["rotor_inertia"] = _rounded(projection.armature[index] / gear**2)
        joint["viscous"] = _rounded(projection.viscous[index])
        joint["coulomb"] = [_rounded(projection.forward[index]), _rounded(projection.backward[index])]
    return yaml.safe_dump(content, sort_keys=False, allow_unicode=True)


def _carried(robot: Robot, moved: set[str]) -> list[str]:
    """Links with an inertial that move with another link."""
    found = []
    for link in robot.links:
        above = {joint.child for joint in robot.path_to(link.name)}
        if link.inertial is not None and link.name not in moved and above & moved:
            found.append(link.name)
    return found


def about_center(ten: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass and the tensor about it, (3, 3), of ten parameters about the joint, in its frame."""
    mass, center = ten[0], ten[1:4] / ten[0]
    xx, xy, xz, yy, yz, zz = ten[4:]
    about_joint = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return mass, center, about_joint - mass * (center @ center * np.eye(3) - np.outer(center, center))


def _in_link(ten: np.ndarray, turned: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass and tensor about it in the link's frame; ``turned`` takes +z to the joint's axis."""
    mass, center, tensor = about_center(ten)
    return mass, turned @ center, turned @ tensor @ turned.T


def _set_inertial(link: etree._Element, values: tuple[float, np.ndarray, np.ndarray]) -> None:
    mass, center, tensor = values
    for old in link.findall("inertial"):
        link.remove(old)
    inertial = etree.Element("inertial")
    etree.SubElement(inertial, "origin", xyz=" ".join(map(_number, center)), rpy="0 0 0")
    etree.SubElement(inertial, "mass", value=_number(mass))
    etree.SubElement(
        inertial, "inertia", dict(zip(TEN, map(_number, tensor[np.triu_indices(3)]), strict=True))
    )
    link.insert(0, inertial)


def _rounded(value: float) -> float:
    return float(_number(value))


def _number(value: float) -> str:
    return f"{value:.12g}"
