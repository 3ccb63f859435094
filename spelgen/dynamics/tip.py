"""Where the tip of the arm is: forward kinematics of the run's URDF by pytorch-kinematics."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import pytorch_kinematics as pk
import torch

from spelgen.urdf.read import read_urdf
from spelgen.urdf.robot import Robot


def tip_position(
    urdf: Path, joints: Sequence[str], tip: str | None
) -> Callable[[torch.Tensor], torch.Tensor]:
    """A function of q, (..., n) [rad, m], to the position of the link `tip`, (..., 3) [m], in the root link's
    frame.

    tip: by default the link after the last joint, or the end of the fixed links that follow it. Joints other
    than the n named ones stand at zero. Offsets are single precision in pytorch-kinematics: errors near 1e-7
    m. Raises what pytorch-kinematics raises where it cannot read the file.
    """
    robot = read_urdf(urdf)
    link = tip or _last_link(robot, joints)
    chain = pk.build_serial_chain_from_urdf(urdf.read_bytes(), link).to(dtype=torch.float64)
    names = chain.get_joint_parameter_names()
    missing = sorted(set(joints) - set(names))
    if missing:
        raise ValueError(f"the joints {', '.join(missing)} do not lead to {link}")
    places = [names.index(joint) for joint in joints]

    def position(q: torch.Tensor) -> torch.Tensor:
        angles = q.new_zeros(*q.shape[:-1], len(names))
        angles[..., places] = q
        poses = chain.forward_kinematics(angles.reshape(-1, len(names))).get_matrix()  # (N, 4, 4)
        return poses[:, :3, 3].reshape(*q.shape[:-1], 3)

    return position


def _last_link(robot: Robot, joints: Sequence[str]) -> str:
    link = next(joint.child for joint in robot.joints if joint.name == joints[-1])
    while True:
        fixed = [joint.child for joint in robot.joints if joint.parent == link and joint.type == "fixed"]
        if len(fixed) != 1:
            return link
        link = fixed[0]
