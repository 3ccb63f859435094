"""Rigid bodies -> a URDF and the settings beside it: the arm's own files with other numbers in them."""

from __future__ import annotations

import numpy as np
import yaml
from lxml import etree

from spelgen.arm.chain import choose_chain
from spelgen.arm.lump_links import lump_links
from spelgen.dynamics.rigid_bodies import about_center
from spelgen.exporting.rigid_body_projection import RigidBodyProjection
from spelgen.urdf.document import urdf_bytes


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
    chain = choose_chain(robot, arm.joint_names, None)
    lumped = lump_links(robot, chain, projection.arm.angle_tolerance)
    for body, inertia in zip(lumped.moved, projection.inertias, strict=True):
        for link in body.links:
            _remove(links[link.name], "inertial")
        name = body.joint.child
        # of the body's frame, whose z is the joint's axis, in the link's
        rotation = np.array(lumped.frames[name].rotation.T, dtype=float)
        _set_inertial(links[name], inertia, rotation)
    # a URDF has one Coulomb friction for both directions
    friction = projection.friction
    coulomb = (friction.forward - friction.backward) / 2
    for index, coordinate in enumerate(arm.coordinates):
        element = joints[coordinate.name]
        _remove(element, "dynamics")
        values = {"damping": _number(friction.viscous[index]), "friction": _number(coulomb[index])}
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
    friction = projection.friction
    for index, coordinate in enumerate(projection.arm.arm.coordinates):
        # settings have the rotor's own inertia, the model that of the joint's side
        gear = projection.arm.settings.joint(coordinate.name).gear
        joint = joints.setdefault(coordinate.name, {})
        joint["rotor_inertia"] = rounded(projection.armature[index] / gear**2)
        joint["viscous"] = rounded(friction.viscous[index])
        joint["coulomb"] = [rounded(friction.forward[index]), rounded(friction.backward[index])]
    text: str = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
    return text


def rounded(value: float) -> float:
    """Return a number of twelve digits: what a person may read, far beyond what a fit finds."""
    return float(_number(value))


def _set_inertial(link: etree._Element, inertia: np.ndarray, rotation: np.ndarray) -> None:
    """Set the inertial of a link in whose frame the body's stands at ``rotation``."""
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
