"""The kinematic tree and the triangles of an arm, for the animated picture on a page.

The triangles are the simplified visual shapes of the URDF. A link whose shapes cannot be read is drawn as tubes from
joint to joint, with drums about the joint axes. If no shape can be read, all links are drawn in this way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import numpy as np
from pydantic import PlainSerializer, PlainValidator
from scipy.spatial.transform import Rotation

from spelgen.dynamics.constraint import Constraint, mimic_constraint
from spelgen.evaluation.plain import Curve
from spelgen.render.charts import TUNING
from spelgen.urdf.geometry import LinkShape, link_shapes
from spelgen.urdf.read import read_urdf
from spelgen.urdf.robot import Robot, UrdfJoint

if TYPE_CHECKING:
    from trimesh import Trimesh


@dataclass(frozen=True, eq=False)
class SceneLink:
    """A link in the animated picture of an arm, and its motion relative to its parent.

    The displacement of the joint is ratio * q[joint] + offset [rad, m].

    Attributes:
        name: Name of the link.
        parent: Index of the parent link; -1 for the root.
        rotation: Rotation from the joint frame to the parent's frame, (3, 3).
        position: Origin of the joint frame in the parent's frame, (3,) [m].
        axis: Joint axis in the joint frame, (3,).
        slides: Whether the link moves along the axis; otherwise it rotates about the axis.
        joint: Index of the joint in q; -1 for a link that does not move relative to its parent.
        ratio: Displacement of the joint divided by the displacement of q[joint].
        offset: Displacement for q[joint] = 0 [rad, m].
        shape: Triangles of the link.
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
    """The links of an arm with their shapes for the animated picture; parents precede their children.

    extent: sum of the distances between joints [m]. tubes: sentence about the links that are drawn as tubes.
    """

    links: tuple[SceneLink, ...]
    extent: float
    tubes: str


def scene(urdf: Path, joints: Sequence[str]) -> Scene:
    """Return the links of an arm with their shapes, for the animated picture on a page.

    joints: names of the moving joints of the arm. Raises the errors of ``read_urdf``.
    """
    robot = read_urdf(urdf)
    constraint = mimic_constraint(robot, joints)
    # Other branches of the robot (a second arm, a base with wheels) are not drawn.
    names = _links(robot, joints)
    visual = link_shapes(urdf, "visual", names, TUNING.faces)
    tubes = f" Drawn as tubes, since meshes were not read: {visual.unread_text}." if visual.unread else ""
    if not visual.shapes:
        tubes = " No meshes were read; links are drawn as tubes."
    lengths = [np.linalg.norm(joint.xyz) for name, joint in robot.joint_above.items() if name in names]
    # The extent is the sum of all lengths, as the distance to the tip depends on the configuration. The lower bound
    # avoids an extent of zero if all joints coincide.
    extent = max(float(sum(lengths)), 1e-3)
    links = []
    for name in names:
        if name in visual.unread or not visual.shapes:
            shape = _tubes(robot, name, names, TUNING.tube_radius * extent)
        else:
            shape = joined([triangles(shape) for shape in visual.shapes if shape.link == name])
        links.append(_link(robot, name, names, constraint, shape))
    return Scene(tuple(links), extent, tubes)


def _link(robot: Robot, name: str, names: Sequence[str], constraint: Constraint, shape: Shape) -> SceneLink:
    joint = robot.joint_above.get(name)
    if joint is None:
        root = np.zeros(3)
        return SceneLink(name, -1, np.eye(3), root, np.array([0.0, 0.0, 1.0]), False, -1, 0.0, 0.0, shape)
    driver, ratio, offset = -1, 0.0, 0.0
    if joint.moves:
        # A mimic joint moves with its driving joint; a locked joint does not move, and all its ratios are zero.
        row = constraint.names.index(joint.name)
        offset = float(constraint.offset[row])
        driver = next(iter(np.flatnonzero(constraint.jacobian[row]).tolist()), -1)
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
    """Return the names of the links that the animated picture of an arm shows, parents first.

    The picture shows the links from the root to each of the `joints`, all links that move with the joints, and links
    that are fixed to another shown link. robot: the URDF with all its links.
    """
    leading = {joint.name for name in joints for joint in robot.path_to(robot.joint[name].child)}
    carried = set()
    visible = [robot.root]
    for joint in robot.joints_from_root:
        # A link moves with the arm if its joint belongs to the arm or its parent link moves with the arm.
        if joint.name in joints or joint.parent in carried:
            carried.add(joint.child)
        fixed = joint.parent in visible and not joint.moves
        if fixed or joint.name in leading or joint.child in carried:
            visible.append(joint.child)
    return visible


def _tubes(robot: Robot, name: str, names: Sequence[str], radius: float) -> Shape:
    """Return the shape of a link without meshes: tubes from the link's origin to its child joints.

    A link without child joints has a tube to its centre of mass. The joint of the link is drawn as a drum about the
    joint axis. robot: the URDF. name: name of the link. names: names of all drawn links. radius: radius of the tubes
    [m].
    """
    joint, inertial = robot.joint_above.get(name), robot.link[name].inertial
    below = [joint for joint in robot.joints_below[name] if joint.child in names]
    meshes = []
    for carried in below:
        end = np.array(carried.xyz, dtype=float)
        meshes += tube(np.zeros(3), end, radius)
        if carried.type == "prismatic":  # A thin tube shows the range of the prismatic joint.
            travel = max(abs(carried.lower or 0.0), abs(carried.upper or 0.0))
            meshes += tube(end, end + travel * _rotation(carried) @ _axis(carried), 0.4 * radius)
    # A last link without child joints gets a tube to its centre of mass; otherwise it would be invisible.
    if not below and inertial is not None:
        meshes += tube(np.zeros(3), np.array(inertial.com, dtype=float), 0.7 * radius)
    if joint is not None and joint.moves:
        ends = 1.725 * radius * _axis(joint)
        meshes += tube(-ends, ends, 1.5 * radius)
    return joined(meshes)


def _axis(joint: UrdfJoint) -> np.ndarray:
    """Return the unit vector of the axis of a URDF joint, (3,), in the joint frame."""
    axis = np.array(joint.axis, dtype=float)
    return axis / (np.linalg.norm(axis) or 1.0)


def _rotation(joint: UrdfJoint) -> np.ndarray:
    """Return the rotation matrix (3, 3) from the frame of a URDF joint to its parent's frame.

    It is computed from roll, pitch and yaw about fixed axes [rad].
    """
    return np.asarray(Rotation.from_euler("xyz", joint.rpy).as_matrix())


@dataclass(frozen=True, eq=False)
class Shape:
    """Triangle mesh of a link, in the frame of the link.

    vertices: (V, 3) [m], V vertices. faces: (F, 3), vertex indices of F triangles, counterclockwise from outside.
    """

    vertices: Curve
    faces: Annotated[np.ndarray, PlainValidator(np.array), PlainSerializer(np.ndarray.tolist)]


def joined(meshes: Sequence[Trimesh]) -> Shape:
    """Return one shape with the triangles of all meshes, which are in the frame of one link."""
    import trimesh

    if not meshes:
        return Shape(np.zeros((0, 3)), np.zeros((0, 3), dtype=int))
    mesh = cast("Trimesh", trimesh.util.concatenate(meshes))
    return Shape(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def tube(start: np.ndarray, end: np.ndarray, radius: float) -> list[Trimesh]:
    """Return a closed prism as a list of one mesh; an empty list if the prism is shorter than half its radius.

    Args:
        start: First end point of the prism's axis, (3,) [m].
        end: Second end point of the prism's axis, (3,) [m].
        radius: Radius of the circumscribed cylinder [m].
    """
    import trimesh

    # A tube between joints at nearly the same place would be a disc, so it is omitted.
    if np.linalg.norm(end - start) <= radius / 2:
        return []
    return [trimesh.creation.cylinder(radius, segment=[start, end], sections=10)]


def triangles(shape: LinkShape) -> Trimesh:
    """Return the triangle mesh of a visual shape (mesh, box, cylinder or sphere) in the frame of its link."""
    from trimesh import Trimesh, creation

    # Cylinders have 12 sides and spheres 8 x 10 faces: pages must remain small, and edges are not visible.
    if shape.mesh is not None:
        mesh = Trimesh(*shape.mesh, process=False)
    elif shape.kind == "box":
        mesh = creation.box(extents=shape.size)
    elif shape.kind == "cylinder":
        mesh = creation.cylinder(radius=shape.size[0], height=shape.size[1], sections=12)
    else:
        mesh = creation.uv_sphere(shape.size[0], count=[8, 10])
    mesh.apply_transform(shape.pose)
    return mesh
