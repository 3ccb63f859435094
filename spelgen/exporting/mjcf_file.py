"""Rigid bodies -> MJCF, MuJoCo's own file: bodies in their joints' frames, drives, friction as MuJoCo has it."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from lxml import etree

from spelgen.arm.arm import Body, Coordinate
from spelgen.exporting.description import Servos
from spelgen.exporting.rigid_body_projection import RigidBodyProjection
from spelgen.exporting.urdf_file import about_center

HARD = "0.9999 0.9999 0.001 0.5 2"  # as hard as MuJoCo has friction: its default lets a loaded joint creep at rest


def mjcf_text(
    projection: RigidBodyProjection,
    inputs: np.ndarray,
    tip: tuple[str, int, np.ndarray],
    servos: Servos | None = None,
) -> bytes:
    """The MJCF of these bodies.

    inputs: G, (n, n), each of whose columns that is not zero becomes an actuator; under position servos each joint has
    one for its position instead. tip: a link, the body that it moves
    with, and its pose in that body's frame, (4, 4).
    """
    arm = projection.arm.arm
    root = etree.Element("mujoco", model=arm.name)
    etree.SubElement(root, "compiler", angle="radian", autolimits="true")
    etree.SubElement(root, "option", gravity=_numbers(float(x) for x in arm.gravity))
    world = etree.SubElement(root, "worldbody")
    placed: list[etree._Element] = []
    for index, body in enumerate(arm.bodies):
        above = world if body.parent < 0 else placed[body.parent]
        placed.append(_body(above, projection, index, body))
    link, carrier, pose = tip
    pose_of = {"pos": _numbers(pose[:3, 3]), "quat": _numbers(_quaternion(pose[:3, :3]))}
    etree.SubElement(placed[carrier], "site", name=link, **pose_of)
    _couple(root, arm.bodies, arm.coordinates)
    for k in _coupled(projection.motors):
        _tendon(root, f"rotor{k + 1}", arm.coordinates, projection.motors[k], projection.armature[k])
    if servos is None:
        _drive(root, arm.coordinates, inputs)
    else:
        _hold(root, arm.coordinates, servos)
    etree.indent(root)
    return etree.tostring(root, xml_declaration=True, encoding="utf-8") + b"\n"


def _body(above: etree._Element, projection: RigidBodyProjection, index: int, body: Body) -> etree._Element:
    coordinates = projection.arm.arm.coordinates
    rotation = np.array(body.rotation, dtype=float)
    found = etree.SubElement(
        above,
        "body",
        name=projection.arm.robot.joint[body.name].child,
        pos=_numbers(float(x) for x in body.translation),
        quat=_numbers(_quaternion(rotation)),
    )
    mass, center, tensor = about_center(projection.inertias[index])
    etree.SubElement(
        found,
        "inertial",
        mass=_number(mass),
        pos=_numbers(center),
        fullinertia=_numbers(tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]),
    )
    joint = {"name": body.name, "axis": "0 0 1", "type": "hinge" if body.kind == "revolute" else "slide"}
    own = coordinates[body.coordinate]
    if own.name == body.name:
        place = body.coordinate
        joint["armature"] = _number(0 if place in _coupled(projection.motors) else projection.armature[place])
        joint["damping"] = _number(projection.viscous[place])
        joint["frictionloss"] = _number((projection.forward[place] - projection.backward[place]) / 2)
        joint["solimpfriction"] = HARD
        if not own.continuous and own.lower is not None and own.upper is not None:
            joint["range"] = _numbers((own.lower, own.upper))
    etree.SubElement(found, "joint", joint)
    return found


def _couple(root: etree._Element, bodies: Iterable[Body], coordinates: tuple[Coordinate, ...]) -> None:
    """Joints that follow others, as MuJoCo has it: by a soft constraint."""
    followers = [body for body in bodies if coordinates[body.coordinate].name != body.name]
    if not followers:
        return
    equality = etree.SubElement(root, "equality")
    for body in followers:
        law = (body.offset, float(body.multiplier), 0, 0, 0)
        leader = coordinates[body.coordinate].name
        etree.SubElement(equality, "joint", joint1=body.name, joint2=leader, polycoef=_numbers(law))


def _drive(root: etree._Element, coordinates: tuple[Coordinate, ...], inputs: np.ndarray) -> None:
    """A motor for each input: at its joint, or at a tendon where it moves several."""
    columns = [(k, column) for k, column in enumerate(inputs.T) if column.any()]
    for k, column in columns:
        if np.count_nonzero(column) > 1:
            _tendon(root, f"motor{k + 1}", coordinates, column)
    actuators = etree.SubElement(root, "actuator")
    for k, column in columns:
        name = coordinates[k].name
        if np.count_nonzero(column) > 1:
            etree.SubElement(actuators, "motor", name=name, tendon=f"motor{k + 1}")
        else:
            (joint,) = np.flatnonzero(column)
            where = coordinates[int(joint)].name
            etree.SubElement(actuators, "motor", name=name, joint=where, gear=_number(column[joint]))


def _coupled(motors: np.ndarray) -> list[int]:
    """The motors that move several joints, or are moved by them."""
    return [k for k, row in enumerate(motors) if np.count_nonzero(row) > 1]


def _tendon(
    root: etree._Element,
    name: str,
    coordinates: tuple[Coordinate, ...],
    coefficients: np.ndarray,
    armature: float = 0.0,
) -> None:
    """A sum of joint positions times coefficients; armature: of what turns by it."""
    tendons = root.find("tendon")
    tendons = etree.SubElement(root, "tendon") if tendons is None else tendons
    fixed = etree.SubElement(tendons, "fixed", name=name)
    if armature:
        fixed.set("armature", _number(armature))
    for joint in np.flatnonzero(coefficients):
        coefficient = _number(coefficients[joint])
        etree.SubElement(fixed, "joint", joint=coordinates[int(joint)].name, coef=coefficient)


def _hold(root: etree._Element, coordinates: tuple[Coordinate, ...], servos: Servos) -> None:
    """A position actuator for each joint; its control is the delayed command."""
    actuators = etree.SubElement(root, "actuator")
    for coordinate, kp, kd, limit in zip(coordinates, servos.kp, servos.kd, servos.limit, strict=True):
        about = {"name": coordinate.name, "joint": coordinate.name, "kp": _number(kp), "kv": _number(kd)}
        if np.isfinite(limit):
            about["forcerange"] = _numbers((-limit, limit))
        etree.SubElement(actuators, "position", about)


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """(w, x, y, z) of a rotation matrix (Bar-Itzhack's eigenvector, JGCD 23:1085, 2000)."""
    r = rotation
    symmetric = np.array(
        [
            [r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [0, r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
            [0, 0, r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1]],
            [0, 0, 0, r[2, 2] - r[0, 0] - r[1, 1]],
        ]
    )
    found: np.ndarray = np.linalg.eigh(symmetric, UPLO="U")[1][:, -1]
    found = np.where(np.abs(found) < 1e-16, 0.0, found)
    return found if found[0] >= 0 else -found


def _numbers(values: Iterable[float]) -> str:
    return " ".join(map(_number, values))


def _number(value: float) -> str:
    return f"{float(value):.17g}"
