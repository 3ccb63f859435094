"""A URDF -> the arm as a page draws it: links that hang on one another, as tubes from joint to joint.

A drum lies about the axis of each joint that moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from spelgen.dynamics.constraint import Constraint, mimic_constraint
from spelgen.evaluation.plain import Curve
from spelgen.settings.tuning.render import TUNING
from spelgen.urdf.read import read_urdf
from spelgen.urdf.robot import Joint, Robot

SIDES = 10


@dataclass(frozen=True, eq=False)
class Shape:
    """Vertices (V, 3) [m] in the link's frame, and faces: corners of each, seen from outside counterclockwise."""

    vertices: Curve
    faces: list[list[int]]


@dataclass(frozen=True, eq=False)
class SceneLink:
    """Hold a link, and the joint that carries it.

    It stands at rotation (3, 3) and position (3,) in its parent's frame and then turns about its axis, or slides along
    it, by ratio * q[joint] + offset. joint: -1, it is fixed.
    """

    name: str
    parent: int
    rotation: Curve
    position: Curve
    axis: Curve
    slides: bool
    joint: int
    ratio: float
    offset: float
    shape: Shape


@dataclass(frozen=True, eq=False)
class Scene:
    """Links, parents first, and how far the arm reaches [m]."""

    links: tuple[SceneLink, ...]
    reach: float


def scene(urdf: Path, joints: Sequence[str]) -> Scene:
    """Return the arm of these joints. Raises what reading the URDF raises."""
    robot = read_urdf(urdf)
    constraint = mimic_constraint(robot, joints)
    names = _links(robot, joints)
    lengths = [np.linalg.norm(joint.xyz) for name, joint in robot.joint_above.items() if name in names]
    reach = max(float(sum(lengths)), 1e-3)  # an arm of joints in one point has a size, too
    radius = TUNING.tube_radius * reach
    links = [_link(robot, name, names, constraint, _tubes(robot, name, names, radius)) for name in names]
    return Scene(tuple(links), reach)


def _link(robot: Robot, name: str, names: Sequence[str], constraint: Constraint, shape: Shape) -> SceneLink:
    joint = robot.joint_above.get(name)
    if joint is None:
        root = np.zeros(3)
        return SceneLink(name, -1, np.eye(3), root, np.array([0.0, 0.0, 1.0]), False, -1, 0.0, 0.0, shape)
    driver, ratio, offset = -1, 0.0, 0.0
    if joint.moves:
        # a mimic joint follows the joint that drives it; a locked one follows none
        row = constraint.names.index(joint.name)
        offset = float(constraint.offset[row])
        drivers = np.flatnonzero(constraint.jacobian[row])
        if len(drivers):
            driver = int(drivers[0])
            ratio = float(constraint.jacobian[row, driver])
    return SceneLink(
        name=name,
        parent=names.index(joint.parent) if joint.parent in names else -1,
        rotation=_rotation(joint),
        position=np.array(joint.xyz, dtype=float),
        axis=_axis(joint),
        slides=joint.type == "prismatic",
        joint=driver,
        ratio=ratio,
        offset=offset,
        shape=shape,
    )


def _links(robot: Robot, joints: Sequence[str]) -> list[str]:
    """Return the links from the root to the last joint and what the joints carry; parents first.

    What is fixed to these links is among them.
    """
    leading = {joint.name for name in joints for joint in robot.path_to(robot.joint[name].child)}
    carried: set[str] = set()
    visible = [robot.root]
    for joint in robot.joints_from_root:
        # whatever hangs on a carried link is carried, too
        if joint.name in joints or joint.parent in carried:
            carried.add(joint.child)
        fixed = joint.parent in visible and not joint.moves
        if fixed or joint.name in leading or joint.child in carried:
            visible.append(joint.child)
    return visible


def _tubes(robot: Robot, name: str, names: Sequence[str], radius: float) -> Shape:
    """Return tubes from the link's origin to the joints that it carries; the last link ends at its centre of mass."""
    joint, inertial = robot.joint_above.get(name), robot.link[name].inertial
    below = [joint for joint in robot.joints_below[name] if joint.child in names]
    origin = np.zeros(3)
    tubes = []
    for carried in below:
        end = np.array(carried.xyz, dtype=float)
        tubes.append((origin, end, radius))
        if carried.type == "prismatic":  # its rail
            travel = max(abs(carried.lower or 0.0), abs(carried.upper or 0.0))
            tubes.append((end, end + travel * _rotation(carried) @ _axis(carried), 0.4 * radius))
    if not below and inertial is not None:
        tubes.append((origin, np.array(inertial.com, dtype=float), 0.7 * radius))
    if joint is not None and joint.moves:  # a drum about its axis
        tip = 1.7 * radius * _axis(joint)
        tubes.append((-tip, tip, 1.5 * radius))
    return prisms(tubes)


def prisms(tubes: Sequence[tuple[np.ndarray, np.ndarray, float]]) -> Shape:
    """Return tubes, each of start, end and radius, with their lids; none where it is shorter than half its radius."""
    corners: list[list[float]] = []
    faces: list[list[int]] = []
    angle = 2 * np.pi / SIDES * np.arange(SIDES)[:, None]
    for start, end, radius in tubes:
        length = np.linalg.norm(end - start)
        if length <= radius / 2:
            continue
        along = (end - start) / length
        across = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
        across /= np.linalg.norm(across)
        ring = radius * (np.cos(angle) * across + np.sin(angle) * np.cross(along, across))
        lower = len(corners) + np.arange(SIDES)
        upper = lower + SIDES
        corners += np.concatenate([start + ring, end + ring]).tolist()
        sides = np.stack([lower, np.roll(lower, -1), np.roll(upper, -1), upper], axis=1)
        faces += [lower[::-1].tolist(), upper.tolist(), *sides.tolist()]
    return Shape(np.array(corners), faces)


def _axis(joint: Joint) -> np.ndarray:
    axis = np.array(joint.axis, dtype=float)
    unit: np.ndarray = axis / (np.linalg.norm(axis) or 1.0)
    return unit


def _rotation(joint: Joint) -> np.ndarray:
    """Return the rotation of roll, pitch and yaw, about fixed axes."""
    matrix: np.ndarray = Rotation.from_euler("xyz", joint.rpy).as_matrix()
    return matrix
