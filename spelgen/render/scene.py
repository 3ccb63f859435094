"""A URDF -> the arm as a page draws it: links that hang on one another, each with its triangles.

The triangles are those of the file's visual shapes where these are found, simplified to fit a page; else tubes from
joint to joint, with a drum about the axis of each that turns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from spelgen.dynamics.constraint import Constraint, mimic_constraint
from spelgen.evaluation.plain import Curve
from spelgen.render.shapes import Shape, joined, tube, visual_shapes
from spelgen.render.tuning import TUNING
from spelgen.urdf.read import read_urdf
from spelgen.urdf.robot import Joint, Robot


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
    """Links, parents first, and how far the arm reaches [m]. has_meshes: whether the shapes are the file's own."""

    links: tuple[SceneLink, ...]
    reach: float
    has_meshes: bool


def scene(urdf: Path, joints: Sequence[str]) -> Scene:
    """Return the arm of these joints. Raises what reading the URDF raises."""
    robot = read_urdf(urdf)
    constraint = mimic_constraint(robot, joints)
    names = _links(robot, joints)
    shapes = visual_shapes(urdf, names)
    lengths = [np.linalg.norm(joint.xyz) for name, joint in robot.joint_above.items() if name in names]
    reach = max(float(sum(lengths)), 1e-3)  # an arm of joints in one point has a size, too
    links = []
    for name in names:
        if shapes:
            shape = shapes.get(name, joined([]))
        else:
            shape = _tubes(robot, name, names, TUNING.tube_radius * reach)
        links.append(_link(robot, name, names, constraint, shape))
    return Scene(tuple(links), reach, bool(shapes))


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
    meshes = []
    for carried in below:
        end = np.array(carried.xyz, dtype=float)
        meshes += tube(np.zeros(3), end, radius)
        if carried.type == "prismatic":  # its rail
            travel = max(abs(carried.lower or 0.0), abs(carried.upper or 0.0))
            meshes += tube(end, end + travel * _rotation(carried) @ _axis(carried), 0.4 * radius)
    if not below and inertial is not None:
        meshes += tube(np.zeros(3), np.array(inertial.com, dtype=float), 0.7 * radius)
    if joint is not None and joint.moves:
        sides, width, half = (4, 1.8, 2.4) if joint.type == "prismatic" else (10, 1.5, 1.725)
        ends = half * radius * _axis(joint)
        meshes += tube(-ends, ends, width * radius, sides)
    return joined(meshes)


def _axis(joint: Joint) -> np.ndarray:
    axis = np.array(joint.axis, dtype=float)
    unit: np.ndarray = axis / (np.linalg.norm(axis) or 1.0)
    return unit


def _rotation(joint: Joint) -> np.ndarray:
    """Return the rotation of roll, pitch and yaw, about fixed axes."""
    matrix: np.ndarray = Rotation.from_euler("xyz", joint.rpy).as_matrix()
    return matrix
