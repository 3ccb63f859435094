"""Kinematics of the tip of an arm."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from spelgen.dynamics.constraint import mimic_constraint
from spelgen.urdf.read import read_urdf
from spelgen.urdf.robot import Robot, UrdfJoint


class TipKinematics:
    """Pose and Jacobian of a link in the frame of the root link, as functions of q (..., n) [rad, m].

    Mimic joints move with their leaders, all other joints are at zero. Angles are the unrounded angles of the URDF.
    Results have the type of q.
    """

    def __init__(self, robot: Robot, joints: Sequence[str], link: str) -> None:
        self.link = link
        constraint = mimic_constraint(robot, joints)
        rows: list[int] = []
        self._placements: list[
            torch.Tensor
        ] = []  # of each moving joint, after the one before it, then of the tip
        self._revolute: list[bool] = []
        axes: list[np.ndarray] = []
        self._generators: list[torch.Tensor] = []
        placement = np.eye(4)
        for joint in robot.path_to(link):
            placement = placement @ _placement(joint)
            if joint.moves:
                rows.append(constraint.names.index(joint.name))
                axes.append(np.array(joint.axis) / np.linalg.norm(joint.axis))
                self._revolute.append(joint.type != "prismatic")
                self._generators.append(torch.from_numpy(_generator(axes[-1], self._revolute[-1])))
                self._placements.append(torch.from_numpy(placement))
                placement = np.eye(4)
        self._placements.append(torch.from_numpy(placement))
        self._axes = torch.from_numpy(np.reshape(axes, (-1, 3)))
        self._jacobian = torch.from_numpy(constraint.jacobian[rows])  # (joints of the path, n)
        self._offset = torch.from_numpy(constraint.offset[rows])
        missing = [name for name, column in zip(joints, self._jacobian.T, strict=True) if not column.any()]
        if missing:
            raise ValueError(f"the joints {', '.join(missing)} do not lead to {link}")

    def pose(self, q: torch.Tensor) -> torch.Tensor:
        """Return the homogeneous transform, (..., 4, 4)."""
        return self._frames(q)[-1]

    def position(self, q: torch.Tensor) -> torch.Tensor:
        """Return the origin of the link, (..., 3) [m]."""
        return self.pose(q)[..., :3, 3]

    def jacobian(self, q: torch.Tensor) -> torch.Tensor:
        """Return the Jacobian, (..., 6, n), in root axes: linear [m/s], then angular velocity [rad/s] per qd."""
        *frames, tip = self._frames(q)
        columns: list[torch.Tensor] = []
        for frame, axis, revolute in zip(frames, self._axes.to(q), self._revolute, strict=True):
            along = (frame[..., :3, :3] * axis).sum(dim=-1)  # the axis, (..., 3)
            lever = tip[..., :3, 3] - frame[..., :3, 3]
            velocities = (torch.linalg.cross(along, lever, dim=-1), along) if revolute else (along, 0 * along)
            columns.append(torch.cat(velocities, dim=-1))
        return torch.stack(columns, dim=-1) @ self._jacobian.to(q)

    def _frames(self, q: torch.Tensor) -> list[torch.Tensor]:
        """Return the poses (..., 4, 4) of the moving joints after their motion, and of the tip."""
        *placements, end = (placement.to(q) for placement in self._placements)
        positions = q @ self._jacobian.to(q).mT + self._offset.to(q)
        pose = torch.eye(4).to(q)
        frames: list[torch.Tensor] = []
        for k, (placement, revolute) in enumerate(zip(placements, self._revolute, strict=True)):
            x, generator = positions[..., k, None, None], self._generators[k].to(q)
            # the matrix exponential of x times the generator (Rodrigues); the square is zero for a translation
            first, second = (x.sin(), 1 - x.cos()) if revolute else (x, 0 * x)
            motion = torch.eye(4).to(q) + first * generator + second * (generator @ generator)
            pose = pose @ placement @ motion
            frames.append(pose)
        return [*frames, pose @ end]


def _generator(axis: np.ndarray, revolute: bool) -> np.ndarray:
    """Return the derivative (4, 4) of a rotation about, or of a translation along, a unit axis (3,)."""
    generator = np.zeros((4, 4))
    if revolute:
        generator[:3, :3] = np.cross(axis, np.eye(3)).T
    else:
        generator[:3, 3] = axis
    return generator


def _placement(joint: UrdfJoint) -> np.ndarray:
    """Return the pose (4, 4) of the frame of a joint at zero in the frame of its parent link."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_euler("xyz", joint.rpy).as_matrix(), joint.xyz
    return pose


def tip_kinematics(
    arm: Any, link: str | None = None, *, joints: Sequence[str] | None = None
) -> TipKinematics:
    """Return the kinematics of ``link``.

    By default it is the tip of the arm, or the link after the last joint or the end of the fixed links after that.

    arm: result of ``load_arm``, or the path of a URDF, with the names of its ``joints``. Raises ValueError if the
    joints do not lead to the link.
    """
    if isinstance(arm, str | Path):
        robot, names = read_urdf(Path(arm)), list(joints or ())
    else:
        robot, names = arm.robot, arm.chain.joint_names
        link = link or arm.tip
    if not names:
        raise ValueError("no joints are named")
    return TipKinematics(robot, names, link or last_link(robot, names))


def last_link(robot: Robot, joints: Sequence[str]) -> str:
    """Return the link after the last of these joints, or the end of the fixed links after it."""
    link = robot.joint[joints[-1]].child
    while True:
        fixed = [joint.child for joint in robot.joints_below[link] if joint.type == "fixed"]
        if len(fixed) != 1:
            return link
        link = fixed[0]
