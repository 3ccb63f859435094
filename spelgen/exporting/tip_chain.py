"""The chain from the root link to the tip, in a URDF's own numbers."""

from __future__ import annotations

import numpy as np

from spelgen.arm.arm import Body
from spelgen.arm.rational import alignment, rotation_about, rotation_from_rpy
from spelgen.dynamics.constraint import mimic_constraint
from spelgen.dynamics.tip import last_link
from spelgen.exporting.description import TipJoint
from spelgen.loaded_arm import LoadedArm

_ROUNDING = 1e-15  # what cos(pi / 2) leaves of zero
_Z = np.array([0.0, 0.0, 1.0])


def tip_chain(loaded: LoadedArm) -> tuple[str, tuple[TipJoint, ...], np.ndarray]:
    """Return the tip's link, the joints on the way to it, and the pose of the tip behind the last, (4, 4)."""
    names = [joint.name for joint in loaded.arm.coordinates]
    link = loaded.tip or last_link(loaded.robot, names)
    constraint = mimic_constraint(loaded.robot, names)
    joints: list[TipJoint] = []
    pose = np.eye(4)
    for joint in loaded.robot.path_to(link):
        pose = pose @ _transform(rotation_from_rpy(joint.rpy), joint.xyz)
        if not joint.moves:
            continue
        axis = np.array(joint.axis, dtype=float)
        turned = _transform(alignment(axis / np.linalg.norm(axis)), (0, 0, 0))
        index = constraint.names.index(joint.name)
        row, offset = constraint.jacobian[index], float(constraint.offset[index])
        joints.append(TipJoint(_without_rounding(pose @ turned), joint.type != "prismatic", row, offset))
        pose = turned.T
    return link, tuple(joints), _without_rounding(pose)


def tip_in_body(loaded: LoadedArm) -> tuple[str, int, np.ndarray]:
    """Return the tip's link, the body that carries it, and the tip's pose in that body's frame, (4, 4)."""
    link, joints, end = tip_chain(loaded)
    tip = np.eye(4)
    for joint in joints:
        tip = tip @ joint.origin @ _joint_motion(joint.revolute, joint.offset)
    tip = tip @ end
    names = [body.name for body in loaded.arm.bodies]
    carrier = max(names.index(joint.name) for joint in loaded.robot.path_to(link) if joint.name in names)
    frame, index = np.eye(4), carrier
    while index >= 0:
        body = loaded.arm.bodies[index]
        frame, index = _body_motion(body) @ frame, body.parent
    return link, carrier, np.linalg.solve(frame, tip)


def _body_motion(body: Body) -> np.ndarray:
    """Return a body's pose in its parent's frame where all coordinates are zero, (4, 4)."""
    placed = _transform(body.rotation, body.translation)
    pose: np.ndarray = placed @ _joint_motion(body.kind == "revolute", body.offset)
    return pose


def _joint_motion(revolute: bool, value: float) -> np.ndarray:
    """Return a turn about z [rad] or a displacement along it [m], (4, 4)."""
    if revolute:
        return _transform(rotation_about(_Z, value), (0, 0, 0))
    return _transform(np.eye(3), value * _Z)


def _transform(rotation: object, position: object) -> np.ndarray:
    transform = np.eye(4)
    transform[:3, :3] = np.array(rotation, dtype=float)
    transform[:3, 3] = np.array(position, dtype=float)
    return transform


def _without_rounding(transform: np.ndarray) -> np.ndarray:
    return np.where(np.abs(transform) < _ROUNDING, 0.0, transform)
