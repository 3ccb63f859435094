"""Where the tip of an arm is and how it moves: kinematics along the joints of a URDF, in the file's own numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spelgen.arm.rational import alignment, rotation_from_rpy
from spelgen.dynamics.constraint import mimic_constraint
from spelgen.urdf.read import read_urdf
from spelgen.urdf.robot import Robot

_ROUNDING = 1e-15  # what cos(pi / 2) leaves of zero


@dataclass(frozen=True, eq=False)
class TipJoint:
    """A joint on the way to the tip: origin (4, 4), then a turn about z or a slide along it by row @ q + offset."""

    name: str
    origin: np.ndarray
    revolute: bool
    row: np.ndarray
    offset: float


def tip_chain(robot: Robot, joints: Sequence[str], link: str) -> tuple[tuple[TipJoint, ...], np.ndarray]:
    """Return the joints on the way to a link, by the coordinates ``joints``, and its pose behind the last, (4, 4)."""
    # followers move as their leaders do; what is no coordinate is locked at zero
    constraint = mimic_constraint(robot, joints)
    chain: list[TipJoint] = []
    pose = np.eye(4)
    for joint in robot.path_to(link):
        pose = pose @ transform(rotation_from_rpy(joint.rpy), joint.xyz)
        if not joint.moves:
            continue
        axis = np.array(joint.axis, dtype=float)
        turned = transform(alignment(axis / np.linalg.norm(axis)), (0, 0, 0))
        index = constraint.names.index(joint.name)
        chain.append(
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
    return tuple(chain), _without_rounding(pose)


def transform(rotation: object, position: object) -> np.ndarray:
    """Return the homogeneous transform, (4, 4)."""
    result = np.eye(4)
    result[:3, :3] = np.array(rotation, dtype=float)
    result[:3, 3] = np.array(position, dtype=float)
    return result


def _without_rounding(pose: np.ndarray) -> np.ndarray:
    return np.where(np.abs(pose) < _ROUNDING, 0.0, pose)


class TipKinematics:
    """Pose and Jacobian of a link in the root link's frame, by the coordinates q (..., n) [rad; m].

    Joints that follow others by <mimic> follow here too, all others stand at zero.
    """

    def __init__(self, robot: Robot, joints: Sequence[str], link: str) -> None:
        self.link = link
        self._chain, end = tip_chain(robot, joints, link)
        self._end = torch.from_numpy(end)
        # derivatives of motions about and along z
        self._turn, self._slide = torch.zeros(2, 4, 4, dtype=torch.float64)
        self._turn[1, 0], self._turn[0, 1], self._slide[2, 3] = 1, -1, 1
        self._jacobian = torch.from_numpy(np.array([joint.row for joint in self._chain]))  # (joints, n)
        self._offset = torch.tensor([joint.offset for joint in self._chain], dtype=torch.float64)
        missing = [name for name, column in zip(joints, self._jacobian.T, strict=True) if not column.any()]
        if missing:
            raise ValueError(f"the joints {', '.join(missing)} do not lead to {link}")

    def pose(self, q: Tensor) -> Tensor:
        """The homogeneous transform, (..., 4, 4)."""
        return self._frames(q)[-1] @ self._end

    def position(self, q: Tensor) -> Tensor:
        """The link's origin, (..., 3) [m]."""
        return self.pose(q)[..., :3, 3]

    def jacobian(self, q: Tensor) -> Tensor:
        """Velocity of the link's origin [m/s], then angular velocity [rad/s], by qd; (..., 6, n), in root axes."""
        frames = self._frames(q)
        tip = (frames[-1] @ self._end)[..., :3, 3]
        columns = []
        for joint, frame in zip(self._chain, frames, strict=True):
            # a motion about or along its own axis leaves the axis where it is
            linear, angular = frame[..., :3, 2], torch.zeros_like(tip)
            if joint.revolute:
                angular = linear
                linear = torch.linalg.cross(angular, tip - frame[..., :3, 3])
            columns.append(torch.cat([linear, angular], dim=-1))
        return torch.stack(columns, dim=-1) @ self._jacobian

    def _frames(self, q: Tensor) -> list[Tensor]:
        """Return the pose of each joint's frame behind its motion, (..., 4, 4)."""
        displacements = q.double() @ self._jacobian.mT + self._offset
        still = torch.eye(4, dtype=torch.float64)
        pose, frames = still, []
        for joint, displacement in zip(self._chain, displacements.unbind(-1), strict=True):
            size = displacement[..., None, None]
            motion = still + size * self._slide
            if joint.revolute:
                motion = still + size.sin() * self._turn + (1 - size.cos()) * (self._turn @ self._turn)
            pose = pose @ torch.from_numpy(joint.origin) @ motion
            frames.append(pose)
        return frames


def tip_kinematics(
    arm: Any, link: str | None = None, *, joints: Sequence[str] | None = None
) -> TipKinematics:
    """The kinematics of ``link``: by default the tip that the arm was loaded with, else the link after the last joint
    or the end of the fixed links behind it.

    arm: of ``load_arm``, or the path of a URDF, with the names of its ``joints``. Raises ValueError where the joints
    do not lead to the link.
    """
    if isinstance(arm, str | Path):
        robot, names = read_urdf(Path(arm)), list(joints or ())
    else:
        robot, names = arm.robot, arm.arm.joint_names
        link = link or arm.tip
    if not names:
        raise ValueError("no joints are named")
    return TipKinematics(robot, names, link or last_link(robot, names))


def last_link(robot: Robot, joints: Sequence[str]) -> str:
    """The link after the last of these joints, or the end of the fixed links behind it."""
    link = robot.joint[joints[-1]].child
    while True:
        fixed = [joint.child for joint in robot.joints_below[link] if joint.type == "fixed"]
        if len(fixed) != 1:
            return link
        link = fixed[0]
