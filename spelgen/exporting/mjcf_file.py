"""Rigid bodies -> MJCF, MuJoCo's own file: bodies in their joints' frames, drives, friction as MuJoCo has it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from lxml import etree

from spelgen.arm.arm import Coordinate
from spelgen.dynamics.rigid_bodies import about_center, quaternion
from spelgen.exporting.describe import tip_frame
from spelgen.exporting.description import Servos
from spelgen.exporting.rigid_body_projection import RigidBodyProjection
from spelgen.exporting.tuning import TUNING

SECTIONS = ("worldbody", "equality", "tendon", "actuator")


def mjcf_text(projection: RigidBodyProjection) -> bytes:
    """Return the MJCF of these bodies.

    Each column of G that is not zero becomes an actuator; under position servos each joint has one for its position
    instead.
    """
    arm = projection.arm.arm
    root = etree.Element("mujoco", model=arm.name)
    # MJCF's default is degrees; a limit counts where it stands
    _add(root, "compiler", angle="radian", autolimits="true")
    _add(root, "option", gravity=arm.gravity)
    world, equality, tendons, actuators = (etree.SubElement(root, tag) for tag in SECTIONS)
    is_coupled = np.count_nonzero(projection.motors, axis=1) > 1
    elements = [world]
    for body, inertia in zip(arm.bodies, projection.inertias, strict=True):
        name = projection.arm.robot.joint[body.name].child
        pose = {"pos": body.translation, "quat": quaternion(body.rotation)}
        element = _add(elements[body.parent + 1], "body", name=name, **pose)
        elements.append(element)
        mass, center, tensor = about_center(inertia)
        # MuJoCo has xx, yy, zz, xy, xz, yz
        moments = tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        _add(element, "inertial", mass=mass, pos=center, fullinertia=moments)
        kind = "hinge" if body.kind == "revolute" else "slide"
        joint = {"name": body.name, "axis": (0, 0, 1), "type": kind}
        leader = arm.coordinates[body.coordinate]
        if leader.name == body.name:
            _add(element, "joint", **joint, **_drive(projection, body.coordinate, is_coupled))
            continue
        # a follower has no drive, no friction and no limits of its own; MuJoCo has it by soft constraints, polynomials
        # of the leader's position
        _add(element, "joint", **joint)
        law = body.offset, body.multiplier, 0, 0, 0
        _add(equality, "joint", joint1=body.name, joint2=leader.name, polycoef=law)
    tip = tip_frame(projection.arm)
    pose = {"pos": tip.pose[:3, 3], "quat": quaternion(tip.pose[:3, :3])}
    _add(elements[tip.carrier + 1], "site", name=tip.link, **pose)
    for k in np.flatnonzero(is_coupled).tolist():
        rotor = _add_tendon(tendons, f"rotor{k + 1}", arm.coordinates, projection.motors[k])
        rotor.set("armature", _text(projection.armature[k]))
    if projection.servos is None:
        _add_motors(actuators, tendons, projection)
    else:
        _add_servos(actuators, arm.coordinates, projection.servos)
    for section in (equality, tendons):
        if not len(section):
            root.remove(section)
    # a person may read and change it
    etree.indent(root)
    text: bytes = etree.tostring(root, xml_declaration=True, encoding="utf-8")
    return text + b"\n"


def _drive(projection: RigidBodyProjection, k: int, is_coupled: np.ndarray) -> dict[str, object]:
    """Return the attributes of a joint that is no follower."""
    friction = projection.friction
    return {
        # the rotor of a motor that several joints turn is a tendon's armature
        "armature": 0.0 if is_coupled[k] else projection.armature[k],
        "damping": friction.viscous[k],
        # MuJoCo has one Coulomb friction for both directions
        "frictionloss": (friction.forward[k] - friction.backward[k]) / 2,
        "solimpfriction": " ".join(f"{number:g}" for number in TUNING.friction_impedance),
        "range": projection.arm.arm.coordinates[k].limits,
    }


def _add_motors(actuators: etree._Element, tendons: etree._Element, projection: RigidBodyProjection) -> None:
    """Add a motor for each input: at its joint, or at a tendon where it moves several."""
    joints = projection.arm.arm.coordinates
    for k, column in enumerate(projection.inputs.T):
        name, moved = joints[k].name, np.flatnonzero(column)
        if moved.size == 1:
            (index,) = moved
            _add(actuators, "motor", name=name, joint=joints[index].name, gear=column[index])
        elif moved.size > 1:
            _add_tendon(tendons, f"motor{k + 1}", joints, column)
            _add(actuators, "motor", name=name, tendon=f"motor{k + 1}")


def _add_servos(actuators: etree._Element, joints: Sequence[Coordinate], servos: Servos) -> None:
    """Add a position actuator for each joint; its control is the delayed command."""
    for k, joint in enumerate(joints):
        limit = servos.limit[k]
        force = (-limit, limit) if np.isfinite(limit) else None
        gains = {"kp": servos.kp[k], "kv": servos.kd[k]}
        _add(actuators, "position", name=joint.name, joint=joint.name, **gains, forcerange=force)


def _add_tendon(
    tendons: etree._Element, name: str, joints: Sequence[Coordinate], coefficients: np.ndarray
) -> etree._Element:
    """Add a sum of joint positions times coefficients."""
    tendon = _add(tendons, "fixed", name=name)
    for joint, coefficient in zip(joints, coefficients, strict=True):
        if coefficient:
            _add(tendon, "joint", joint=joint.name, coef=coefficient)
    return tendon


def _add(parent: etree._Element, tag: str, **attributes: object) -> etree._Element:
    """Add an element with these attributes, but those that are None."""
    texts = {name: _text(value) for name, value in attributes.items() if value is not None}
    return etree.SubElement(parent, tag, texts)


def _text(value: object) -> str:
    """Return a text as it is, numbers with all their digits."""
    if isinstance(value, str):
        return value
    return " ".join(f"{float(number):.17g}" for number in np.ravel(value))  # type: ignore[call-overload]
