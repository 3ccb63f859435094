"""The chain from the root link to the tip, in a URDF's own numbers."""

from __future__ import annotations

import numpy as np

from spelgen.arm.rational import alignment, rotation_about, rotation_from_rpy
from spelgen.dynamics.constraint import mimic_constraint
from spelgen.dynamics.tip import last_link
from spelgen.exporting.description import TipJoint
from spelgen.loaded_arm import LoadedArm

_ROUNDING = 1e-15  # what cos(pi / 2) leaves of zero


def tip_chain(loaded: LoadedArm) -> tuple[str, tuple[TipJoint, ...], np.ndarray]:
    """Return the tip's link, the joints on the way to it, and the pose of the tip behind the last, (4, 4)."""
    names = loaded.arm.joint_names
    link = loaded.tip or last_link(loaded.robot, names)
    # followers move as their leaders do; what is no coordinate is locked at zero
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
        joints.append(
            TipJoint(
                name=joint.name,
                origin=_without_rounding(pose @ turned),
                revolute=joint.type != "prismatic",
                row=constraint.jacobian[index],
                offset=float(constraint.offset[index]),
            )
        )
        # the link's own axes again
        pose = turned.T
    return link, tuple(joints), _without_rounding(pose)


def tip_in_body(loaded: LoadedArm) -> tuple[str, int, np.ndarray]:
    """Return the tip's link, the body that carries it, and the tip's pose in that body's frame, (4, 4)."""
    link, joints, end = tip_chain(loaded)
    names = [body.name for body in loaded.arm.bodies]
    carrier = -1
    pose = np.eye(4)
    for joint in joints:
        if joint.name in names:
            # a body's frame is its joint's, with the axis as z
            carrier = names.index(joint.name)
            pose = np.eye(4)
        else:
            pose = pose @ joint.origin @ _locked(joint)
    return link, carrier, pose @ end


def _locked(joint: TipJoint) -> np.ndarray:
    """Return the motion of a joint that stands at its offset, (4, 4)."""
    if joint.revolute:
        return _transform(rotation_about(np.array([0.0, 0.0, 1.0]), joint.offset), (0, 0, 0))
    return _transform(np.eye(3), (0, 0, joint.offset))


def _transform(rotation: object, position: object) -> np.ndarray:
    transform = np.eye(4)
    transform[:3, :3] = np.array(rotation, dtype=float)
    transform[:3, 3] = np.array(position, dtype=float)
    return transform


def _without_rounding(transform: np.ndarray) -> np.ndarray:
    return np.where(np.abs(transform) < _ROUNDING, 0.0, transform)
