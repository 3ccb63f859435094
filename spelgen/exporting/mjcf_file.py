"""Rigid bodies -> MJCF, MuJoCo's own file: bodies in their joints' frames, drives, friction as MuJoCo has it."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from lxml import etree
from scipy.spatial.transform import Rotation

from spelgen.arm.arm import Body
from spelgen.exporting.description import Servos, Tip
from spelgen.exporting.rigid_body_projection import RigidBodyProjection
from spelgen.exporting.urdf_file import about_center

_SOLIMPFRICTION = "0.9999 0.9999 0.001 0.5 2"
"""As hard as MuJoCo has friction: its default lets a loaded joint creep at rest."""


def mjcf_text(
    projection: RigidBodyProjection,
    inputs: np.ndarray,
    tip: Tip,
    servos: Servos | None = None,
) -> bytes:
    """Return the MJCF of these bodies.

    inputs: G, (n, n), each of whose columns that is not zero becomes an actuator; under position servos each joint has
    one for its position instead.
    """
    arm = projection.arm.arm
    root = etree.Element("mujoco", model=arm.name)
    # MJCF's default is degrees; a limit counts where it stands
    etree.SubElement(root, "compiler", angle="radian", autolimits="true")
    etree.SubElement(root, "option", gravity=_numbers(arm.gravity))
    bodies: list[etree._Element] = []
    world = etree.SubElement(root, "worldbody")
    for index, body in enumerate(arm.bodies):
        parent = world if body.parent < 0 else bodies[body.parent]
        bodies.append(_body(parent, projection, index))
    placement = _placement(tip.pose[:3, 3], tip.pose[:3, :3])
    etree.SubElement(bodies[tip.carrier], "site", name=tip.link, **placement)
    _followers(root, projection)
    for k in _coupled_motors(projection):
        _tendon(root, f"rotor{k + 1}", projection, projection.motors[k], projection.armature[k])
    if servos is None:
        _motors(root, projection, inputs)
    else:
        _servos(root, projection, servos)
    # a person may read and change it
    etree.indent(root)
    text: bytes = etree.tostring(root, xml_declaration=True, encoding="utf-8")
    return text + b"\n"


def _body(parent: etree._Element, projection: RigidBodyProjection, index: int) -> etree._Element:
    body = projection.arm.arm.bodies[index]
    mass, center, tensor = about_center(projection.inertias[index])
    name = projection.arm.robot.joint[body.name].child
    element = etree.SubElement(parent, "body", name=name, **_placement(body.translation, body.rotation))
    etree.SubElement(
        element,
        "inertial",
        mass=_number(mass),
        pos=_numbers(center),
        # MuJoCo has xx, yy, zz, xy, xz, yz
        fullinertia=_numbers(tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]),
    )
    etree.SubElement(element, "joint", _joint(projection, body))
    return element


def _joint(projection: RigidBodyProjection, body: Body) -> dict[str, str]:
    """Return the attributes of a joint; a follower has no drive, no friction and no limits of its own."""
    attributes = {"name": body.name, "axis": "0 0 1", "type": "slide"}
    if body.kind == "revolute":
        attributes["type"] = "hinge"
    k = body.coordinate
    coordinate = projection.arm.arm.coordinates[k]
    if coordinate.name != body.name:
        return attributes
    # the rotor of a coupled motor is a tendon's armature
    armature = 0.0 if k in _coupled_motors(projection) else projection.armature[k]
    attributes["armature"] = _number(armature)
    attributes["damping"] = _number(projection.viscous[k])
    # MuJoCo has one Coulomb friction for both directions
    attributes["frictionloss"] = _number((projection.forward[k] - projection.backward[k]) / 2)
    attributes["solimpfriction"] = _SOLIMPFRICTION
    if coordinate.limits is not None:
        attributes["range"] = _numbers(coordinate.limits)
    return attributes


def _followers(root: etree._Element, projection: RigidBodyProjection) -> None:
    """Add the joints that follow others, as MuJoCo has it: by soft constraints."""
    arm = projection.arm.arm
    followers = [body for body in arm.bodies if arm.coordinates[body.coordinate].name != body.name]
    if not followers:
        return
    equality = etree.SubElement(root, "equality")
    for body in followers:
        # a polynomial of the leader's position
        law = _numbers((body.offset, float(body.multiplier), 0, 0, 0))
        leader = arm.coordinates[body.coordinate].name
        etree.SubElement(equality, "joint", joint1=body.name, joint2=leader, polycoef=law)


def _motors(root: etree._Element, projection: RigidBodyProjection, inputs: np.ndarray) -> None:
    """Add a motor for each input: at its joint, or at a tendon where it moves several."""
    joints = projection.arm.arm.coordinates
    actuators = etree.Element("actuator")
    for k, column in enumerate(inputs.T):
        moved = np.flatnonzero(column)
        if moved.size == 1:
            joint, gear = joints[int(moved[0])].name, _number(column[moved[0]])
            etree.SubElement(actuators, "motor", name=joints[k].name, joint=joint, gear=gear)
        elif moved.size > 1:
            _tendon(root, f"motor{k + 1}", projection, column)
            etree.SubElement(actuators, "motor", name=joints[k].name, tendon=f"motor{k + 1}")
    # behind the tendons that it names
    root.append(actuators)


def _servos(root: etree._Element, projection: RigidBodyProjection, servos: Servos) -> None:
    """Add a position actuator for each joint; its control is the delayed command."""
    actuators = etree.SubElement(root, "actuator")
    for k, joint in enumerate(projection.arm.arm.coordinates):
        gains = {"kp": _number(servos.kp[k]), "kv": _number(servos.kd[k])}
        if np.isfinite(servos.limit[k]):
            gains["forcerange"] = _numbers((-servos.limit[k], servos.limit[k]))
        etree.SubElement(actuators, "position", name=joint.name, joint=joint.name, **gains)


def _coupled_motors(projection: RigidBodyProjection) -> list[int]:
    """Return the motors that several joints turn."""
    return np.flatnonzero(np.count_nonzero(projection.motors, axis=1) > 1).tolist()


def _tendon(
    root: etree._Element,
    name: str,
    projection: RigidBodyProjection,
    coefficients: np.ndarray,
    armature: float = 0.0,
) -> None:
    """Add a sum of joint positions times coefficients; armature: of what turns by it."""
    tendons = root.find("tendon")
    if tendons is None:
        tendons = etree.SubElement(root, "tendon")
    fixed = etree.SubElement(tendons, "fixed", name=name)
    if armature:
        fixed.set("armature", _number(armature))
    for joint, coefficient in zip(projection.arm.arm.coordinates, coefficients, strict=True):
        if coefficient:
            etree.SubElement(fixed, "joint", joint=joint.name, coef=_number(coefficient))


def _placement(position: Iterable[object], rotation: object) -> dict[str, str]:
    """Return the attributes of a pose; MuJoCo's quaternions are (w, x, y, z)."""
    matrix = np.array(rotation, dtype=float)
    quaternion = np.roll(Rotation.from_matrix(matrix).as_quat(canonical=True), 1)
    quaternion[np.abs(quaternion) < 1e-16] = 0.0  # rounding
    return {"pos": _numbers(position), "quat": _numbers(quaternion)}


def _numbers(values: Iterable[object]) -> str:
    return " ".join(map(_number, values))


def _number(value: object) -> str:
    return f"{float(value):.17g}"  # type: ignore[arg-type]
