"""Frames of the links of an arm relative to the bodies that carry them, and the kinematics of its tip."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spelgen.arm.arm import Chain, lump_links, make_arm
from spelgen.arm.chain import choose_chain
from spelgen.arm.configured_arm import Arm, load_arm
from spelgen.dynamics.regressor_dynamics import body_chain
from spelgen.dynamics.tip_kinematics import TipKinematics


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


def tip_frame(loaded: Arm, link: str | None = None) -> Tip:
    """Return the frame of a link of an arm, by default the tip link, with the unrounded angles of the URDF."""
    names = loaded.chain.joint_names
    link = link or loaded.tip or loaded.robot.last_link(names)
    # Angles are not rounded: rounding would displace the tip by up to its tolerance times the extent of the arm.
    chain = make_arm(loaded.robot, joints=names, angle_tolerance=0.0, gravity=loaded.settings.gravity)
    return Tip(link, *link_poses(loaded)[link], chain)


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


def tip_kinematics(
    arm: Arm | Path | str, link: str | None = None, *, joints: Sequence[str] | None = None
) -> TipKinematics:
    """Return the kinematics of a link, by default the tip of the arm.

    Mimic joints move with their coordinates; all other joints are at zero. Angles near a multiple of pi/2 are not
    rounded to it, unlike in a `Chain`.

    Args:
        arm: result of ``load_arm``, or the path of a URDF, together with ``joints``.
        link: name of the link; None: the tip of the arm, or the result of `Robot.last_link` if no tip is specified.
        joints: names of the coordinates, if ``arm`` is a path.

    Raises:
        ValueError: a joint does not move the link, or no joints are named.
    """
    if not isinstance(arm, Arm):
        if not joints:
            raise ValueError("no joints are named")
        arm = load_arm(arm, joints)
    tip = tip_frame(arm, link)
    kinematics = TipKinematics(tip.link, body_chain(tip.chain), tip.carrier, tip.pose)
    # A coordinate that does not move the link is an error: it is probably a mistake of the caller.
    names = zip(tip.chain.joint_names, kinematics.joints.T, strict=True)
    missing = [name for name, column in names if not column.any()]
    if missing:
        raise ValueError(f"the joints {', '.join(missing)} do not lead to {tip.link}")
    return kinematics
