"""The tip of an arm: the way to it, and the body that carries it."""

from __future__ import annotations

import numpy as np

from spelgen.arm.rational import rotation_about
from spelgen.dynamics.tip import TipJoint, last_link, tip_chain, transform
from spelgen.loaded_arm import LoadedArm


def arm_tip(loaded: LoadedArm) -> tuple[str, tuple[TipJoint, ...], np.ndarray]:
    """Return the tip's link, the joints on the way to it, and the pose of the tip behind the last, (4, 4)."""
    names = loaded.arm.joint_names
    link = loaded.tip or last_link(loaded.robot, names)
    return link, *tip_chain(loaded.robot, names, link)


def tip_in_body(loaded: LoadedArm) -> tuple[str, int, np.ndarray]:
    """Return the tip's link, the body that carries it, and the tip's pose in that body's frame, (4, 4)."""
    link, joints, end = arm_tip(loaded)
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
        return transform(rotation_about(np.array([0.0, 0.0, 1.0]), joint.offset), (0, 0, 0))
    return transform(np.eye(3), (0, 0, joint.offset))
