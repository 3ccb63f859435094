"""A URDF -> the arm as a page draws it: links that hang on one another, each with its faces.

The faces are those of the file's visual shapes where yourdfpy finds them, simplified to fit a page; else tubes from
joint to joint, with a drum about the axis of each that turns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spelgen.dynamics.constraint import mimic_constraint
from spelgen.render.shapes import Shape, drum, joined, slide, tube, visual_shapes
from spelgen.urdf.read import read_urdf
from spelgen.urdf.robot import Joint, Robot

FACES = 2600  # of all links together
THIN = 0.028  # radius of a tube, of the arm's reach


@dataclass(frozen=True, eq=False)
class SceneLink:
    """A link, and the joint that carries it: it stands at rotation (3, 3) and position (3,) in its parent's frame and
    then turns about its axis, or slides along it, by ratio * q[joint] + offset. joint: -1, it is fixed.
    """

    name: str
    parent: int
    rotation: np.ndarray
    position: np.ndarray
    axis: np.ndarray
    slides: bool
    joint: int
    ratio: float
    offset: float
    shape: Shape


@dataclass(frozen=True, eq=False)
class Scene:
    """Links, parents first, and how far the arm reaches [m]. found: whether the shapes are the file's own."""

    links: tuple[SceneLink, ...]
    reach: float
    found: bool

    def frames(self, q: Sequence[float]) -> list[tuple[np.ndarray, np.ndarray]]:
        """Where the links stand at q: rotation and position of each."""
        placed: list[tuple[np.ndarray, np.ndarray]] = []
        for link in self.links:
            above = placed[link.parent] if link.parent >= 0 else (np.eye(3), np.zeros(3))
            rotation, position = above[0] @ link.rotation, above[1] + above[0] @ link.position
            value = link.offset + (link.ratio * q[link.joint] if link.joint >= 0 else 0.0)
            if link.slides:
                position = position + rotation @ link.axis * value
            else:
                rotation = rotation @ _turn(link.axis, value)
            placed.append((rotation, position))
        return placed

    def to_dict(self) -> dict[str, Any]:
        """For a script, in millimetres and short names."""
        return {
            "reach": round(1000 * self.reach),
            "links": [
                {
                    "parent": link.parent,
                    "R": [round(x, 6) for x in link.rotation.ravel().tolist()],
                    "p": _mm(link.position),
                    "axis": [round(x, 6) for x in link.axis.tolist()],
                    "slides": link.slides,
                    "joint": link.joint,
                    "ratio": link.ratio,
                    "offset": link.offset,
                    "v": [_mm(x) for x in link.shape.vertices],
                    "f": [list(face) for face in link.shape.faces],
                }
                for link in self.links
            ],
        }


def scene(urdf: Path, joints: Sequence[str]) -> Scene:
    """The arm of these joints. Raises what reading the URDF raises."""
    robot = read_urdf(urdf)
    constraint = mimic_constraint(robot, joints)
    links = _links(robot, joints)
    shapes = visual_shapes(urdf, links, FACES)
    known = sum(len(shape.faces) for shape in shapes.values()) > 0
    places = {name: k for k, name in enumerate(links)}
    far = _reach(robot, links)
    built = []
    for name in links:
        joint = robot.joint_above.get(name)
        below = [each for each in robot.joints_below[name] if each.child in places]
        row = constraint.names.index(joint.name) if joint is not None and joint.moves else None
        ratios = np.zeros(1) if row is None else constraint.jacobian[row]
        driven = int(np.flatnonzero(ratios)[0]) if ratios.any() else -1
        axis = np.array(joint.axis if joint is not None else (0, 0, 1), dtype=float)
        axis = axis / (np.linalg.norm(axis) or 1.0)
        shape = shapes.get(name, Shape()) if known else _tubes(robot, name, joint, below, THIN * far, axis)
        built.append(
            SceneLink(
                name=name,
                parent=-1 if joint is None else places.get(joint.parent, -1),
                rotation=_rotation(joint.rpy) if joint is not None else np.eye(3),
                position=np.array(joint.xyz if joint is not None else (0, 0, 0), dtype=float),
                axis=axis,
                slides=joint is not None and joint.type == "prismatic",
                joint=driven,
                ratio=float(ratios[driven]) if driven >= 0 else 0.0,
                offset=0.0 if row is None else float(constraint.offset[row]),
                shape=shape,
            )
        )
    return Scene(tuple(built), far, known)


def _links(robot: Robot, joints: Sequence[str]) -> list[str]:
    """From the root to the last joint, and all that the joints carry; parents first."""
    on_path = {each.parent for name in joints for each in robot.path_to(robot.joint[name].child)}
    carried: set[str] = {robot.joint[name].child for name in joints}
    for joint in robot.joints_from_root:
        if joint.parent in carried:
            carried.add(joint.child)
    return [robot.root, *(x.child for x in robot.joints_from_root if x.child in on_path | carried)]


def _reach(robot: Robot, links: Sequence[str]) -> float:
    lengths = [
        float(np.linalg.norm(robot.joint_above[name].xyz)) for name in links if name in robot.joint_above
    ]
    return max(sum(lengths), 1e-3)


def _tubes(
    robot: Robot, name: str, joint: Joint | None, below: Sequence[Joint], radius: float, axis: np.ndarray
) -> Shape:
    """From the link's origin to the joints that it carries; the last one ends at its centre of mass."""
    ends = [np.array(each.xyz, dtype=float) for each in below]
    inertial = robot.link[name].inertial
    if not ends and inertial is not None:
        ends = [np.array(inertial.com, dtype=float)]
    parts = [
        tube(np.zeros(3), end, radius if below else 0.7 * radius)
        for end in ends
        if np.linalg.norm(end) > radius / 2
    ]
    for each in below:
        if each.type == "prismatic":  # its rail
            along = _rotation(each.rpy) @ np.array(each.axis, dtype=float)
            length = max((abs(x) for x in (each.lower, each.upper) if x is not None), default=0.0)
            if length > radius / 2:
                parts.append(tube(np.array(each.xyz), np.array(each.xyz) + length * along, 0.4 * radius, 6))
    if joint is not None and joint.moves:
        shape = slide if joint.type == "prismatic" else drum
        parts.append(shape(axis, 1.5 * radius))
    return joined(parts)


def _turn(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rodrigues' rotation about a unit axis."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    found: np.ndarray = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return found


def _rotation(rpy: Sequence[float]) -> np.ndarray:
    """Roll, pitch, yaw of a URDF."""
    roll, pitch, yaw = rpy
    x, y, z = np.eye(3)
    return _turn(z, yaw) @ _turn(y, pitch) @ _turn(x, roll)


def _mm(vector: np.ndarray) -> list[float]:
    return [round(1000 * x, 1) for x in vector.tolist()]
