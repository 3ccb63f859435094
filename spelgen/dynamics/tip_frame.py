"""Frames of all links relative to the bodies that carry them, and positions of the joints of all bodies."""

from dataclasses import dataclass

import numpy as np

from spelgen.arm.arm import Chain, lump_links, make_arm
from spelgen.arm.chain import choose_chain
from spelgen.arm.configured_arm import Arm
from spelgen.dynamics.constraint import Constraint


@dataclass(frozen=True, eq=False)
class Tip:
    """The tip link, and its frame relative to the body that carries it.

    Attributes:
        link: name of the tip link.
        carrier: index of the body that carries the link; -1: the root link.
        pose: pose of the link in the frame of this body, (4, 4).
        chain: the arm with the unrounded angles of the URDF, so that poses are equal to the results of other URDF
            parsers.
    """

    link: str
    carrier: int
    pose: np.ndarray
    chain: Chain


def tip_frame(loaded: Arm) -> Tip:
    """Return the tip link of an arm, with its frame in the body that carries it. Angles of the URDF are not rounded."""
    names = loaded.chain.joint_names
    link = loaded.tip or loaded.robot.last_link(names)
    # Angles are not rounded: rounding would displace the tip by up to its tolerance times the extent of the arm.
    chain = make_arm(loaded.robot, joints=names, angle_tolerance=0.0, gravity=loaded.settings.gravity)
    return Tip(link, *link_poses(loaded)[link], chain)


def load_frame(loaded: Arm) -> tuple[str, np.ndarray]:
    """Return the link whose frame describes a payload, and its pose in the frame of the `Chain.load_body`, (4, 4).

    It is the tip link, or the link of the last joint if another body carries the tip link.
    """
    tip, body = tip_frame(loaded), loaded.chain.load_body
    if tip.carrier == body:
        return tip.link, tip.pose
    link = loaded.chain.bodies[body].link
    return link, link_poses(loaded)[link][1]


def link_poses(loaded: Arm, angle_tolerance: float = 0.0) -> dict[str, tuple[int, np.ndarray]]:
    """Return {name of a link: (body, pose)}: the body that carries the link, and the pose of the link, (4, 4).

    The body is an index in `Chain.bodies`, or -1 for the root link. The pose is in the frame of this body. Angles of
    the URDF are rounded with ``angle_tolerance`` [rad].
    """
    chain = choose_chain(loaded.robot, loaded.chain.joint_names, None)
    poses: dict[str, tuple[int, np.ndarray]] = {}
    for link, frame in lump_links(loaded.robot, chain, angle_tolerance).frames.items():
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = frame.rotation, frame.position
        poses[link] = frame.body, pose
    return poses


def body_constraint(arm: Chain) -> Constraint:
    """Return the joint positions of all bodies, (bodies,) [rad, m], as a function K q + offset of q, (n,) [rad, m]."""
    jacobian = np.zeros((len(arm.bodies), len(arm.coordinates)))
    for row, body in enumerate(arm.bodies):
        jacobian[row, body.coordinate] = float(body.multiplier)
    offset = np.array([body.offset for body in arm.bodies], dtype=float)
    return Constraint(tuple(body.name for body in arm.bodies), jacobian, offset)
