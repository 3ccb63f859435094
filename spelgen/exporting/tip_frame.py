"""The frame of the tip's link behind the body that carries it, in a URDF's own numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spelgen.arm.chain import follows
from spelgen.arm.rational import alignment, rotation_about, rotation_from_rpy
from spelgen.dynamics.tip import last_link
from spelgen.exporting.description import Tip
from spelgen.loaded_arm import LoadedArm
from spelgen.urdf.robot import Joint

_ROUNDING = 1e-15  # what cos(pi / 2) leaves of zero


def tip_frame(loaded: LoadedArm) -> Tip:
    """Return the frame of the tip of an arm."""
    bodies = [body.name for body in loaded.arm.bodies]
    link = loaded.tip or last_link(loaded.robot, loaded.arm.joint_names)
    following = follows(loaded.robot)
    carrier = -1
    pose = np.eye(4)
    for joint in loaded.robot.path_to(link):
        if joint.name in bodies:
            # a body's frame is its joint's, with the axis as z
            carrier = bodies.index(joint.name)
            pose = _transform(alignment(_axis(joint)).T, (0, 0, 0))
            continue
        pose = pose @ _transform(rotation_from_rpy(joint.rpy), joint.xyz)
        # what is no coordinate is locked: a follower at its offset, all others at zero
        value = float(following[joint.name].offset)
        if joint.type == "prismatic":
            pose = pose @ _transform(np.eye(3), value * _axis(joint))
        elif joint.moves:
            pose = pose @ _transform(rotation_about(_axis(joint), value), (0, 0, 0))
    return Tip(link, carrier, np.where(np.abs(pose) < _ROUNDING, 0.0, pose))


def _axis(joint: Joint) -> np.ndarray:
    axis: np.ndarray = np.array(joint.axis) / np.linalg.norm(joint.axis)
    return axis


def _transform(rotation: np.ndarray, position: Sequence[float] | np.ndarray) -> np.ndarray:
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = position
    return transform
