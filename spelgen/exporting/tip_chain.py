"""The way from the root link to the tip, in a URDF's own numbers."""

from __future__ import annotations

import numpy as np

from spelgen.arm.rational import rotation_about, rotation_from_rpy
from spelgen.dynamics.constraint import mimic_constraint
from spelgen.dynamics.tip import last_link
from spelgen.exporting.description import TipJoint
from spelgen.loaded_arm import LoadedArm


def tip_chain(loaded: LoadedArm) -> tuple[str, tuple[TipJoint, ...], np.ndarray]:
    """The tip's link, the joints on the way to it as the URDF has them, and the fixed transform behind the last."""
    robot, names = loaded.robot, [coordinate.name for coordinate in loaded.arm.coordinates]
    link = loaded.tip or last_link(robot, names)
    constraint = mimic_constraint(robot, names)
    found: list[TipJoint] = []
    at = np.eye(4)
    for joint in robot.path_to(link):
        origin = np.eye(4)
        origin[:3, :3], origin[:3, 3] = rotation_from_rpy(joint.rpy), joint.xyz
        at = at @ origin
        if not joint.moves:
            continue
        index = constraint.names.index(joint.name)
        kind = "prismatic" if joint.type == "prismatic" else "revolute"
        axis = np.array(joint.axis, dtype=float)
        unit = axis / np.linalg.norm(axis)
        found.append(TipJoint(_clean(at), kind, unit, constraint.jacobian[index], constraint.offset[index]))
        at = np.eye(4)
    return link, tuple(found), _clean(at)


def _clean(transform: np.ndarray) -> np.ndarray:
    """Without the rounding that cos(pi / 2) leaves."""
    return np.where(np.abs(transform) < 1e-15, 0.0, transform)


def tip_in_body(loaded: LoadedArm) -> tuple[str, int, np.ndarray]:
    """The tip's link, the body that it moves with, and its pose in that body's frame, (4, 4)."""
    link, joints, at = tip_chain(loaded)
    for joint in reversed(joints):
        at = joint.origin @ _still(joint) @ at
    names = [body.name for body in loaded.arm.bodies]
    body = max(names.index(each.name) for each in loaded.robot.path_to(link) if each.name in names)
    frame, index = np.eye(4), body
    while index >= 0:
        each = loaded.arm.bodies[index]
        own = np.eye(4)
        own[:3, :3], own[:3, 3] = (
            np.array(each.rotation, dtype=float),
            np.array(each.translation, dtype=float),
        )
        if each.kind == "revolute":
            own[:3, :3] = own[:3, :3] @ rotation_about(np.array([0.0, 0.0, 1.0]), each.offset)
        else:
            own[:3, 3] += own[:3, 2] * each.offset
        frame, index = own @ frame, each.parent
    return link, body, np.linalg.solve(frame, at)


def _still(joint: TipJoint) -> np.ndarray:
    """What a joint adds where all coordinates are zero."""
    found = np.eye(4)
    if joint.kind == "prismatic":
        found[:3, 3] = joint.axis * joint.offset
    else:
        found[:3, :3] = rotation_about(joint.axis, joint.offset)
    return found
