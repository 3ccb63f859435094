"""The frame of the tip link of an arm."""

from dataclasses import dataclass

import numpy as np

from spelgen.arm.arm import Body, lump_links, make_arm
from spelgen.arm.chain import choose_chain
from spelgen.arm.configured_arm import Arm
from spelgen.dynamics.tip import last_link


@dataclass(frozen=True, eq=False)
class Tip:
    """The frame of the tip link.

    carrier: index of the body that carries the link; -1: the root link. pose: (4, 4), in the frame of this body.
    bodies: of the arm with the unrounded angles of the URDF, so that poses equal the ones of other URDF parsers.
    """

    link: str
    carrier: int
    pose: np.ndarray
    bodies: tuple[Body, ...]


def tip_frame(loaded: Arm) -> Tip:
    """Return the frame of the tip link, with the unrounded angles of the URDF."""
    names = loaded.chain.joint_names
    link = loaded.tip or last_link(loaded.robot, names)
    # rounded angles would move the tip by up to the tolerance times the extent of the arm
    bodies = make_arm(loaded.robot, joints=names, angle_tolerance=0.0).bodies
    return Tip(link, *link_poses(loaded)[link], bodies)


def link_poses(loaded: Arm) -> dict[str, tuple[int, np.ndarray]]:
    """Return, by link, the index of the body that carries it, -1: the root link, and the pose (4, 4) in its frame.

    Angles are the unrounded angles of the URDF.
    """
    chain = choose_chain(loaded.robot, loaded.chain.joint_names, None)
    poses: dict[str, tuple[int, np.ndarray]] = {}
    for link, frame in lump_links(loaded.robot, chain, 0.0).frames.items():
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = frame.rotation, frame.position
        poses[link] = frame.body, pose
    return poses
