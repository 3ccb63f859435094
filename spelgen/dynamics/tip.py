"""Kinematics of the tip of an arm by pytorch-kinematics."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from lxml import etree

from spelgen.dynamics.constraint import mimic_constraint
from spelgen.urdf.read import read_urdf
from spelgen.urdf.robot import Robot


class TipKinematics:
    """Pose and Jacobian of a link in the frame of the root link, as functions of q (..., n) [rad, m].

    Mimic joints move with their leaders, all other joints are at zero. Results are float64 with an error of about
    1e-7 rad and m: pytorch-kinematics rounds the offsets of a file to float32. With products in float32 the error would
    be ten times as large.
    """

    def __init__(self, robot: Robot, joints: Sequence[str], link: str) -> None:
        import pytorch_kinematics as pk  # imports matplotlib, which takes long

        self.link = link
        chain = pk.build_serial_chain_from_urdf(_way(robot, link), link)
        self._chain = chain.to(dtype=torch.float64)
        constraint = mimic_constraint(robot, joints)
        order = [constraint.names.index(name) for name in chain.get_joint_parameter_names()]
        self._jacobian = torch.from_numpy(constraint.jacobian[order])  # (joints of the chain, n)
        self._offset = torch.from_numpy(constraint.offset[order])
        missing = [name for name, column in zip(joints, self._jacobian.T, strict=True) if not column.any()]
        if missing:
            raise ValueError(f"the joints {', '.join(missing)} do not lead to {link}")

    def pose(self, q: torch.Tensor) -> torch.Tensor:
        """Return the homogeneous transform, (..., 4, 4)."""
        result: torch.Tensor = self._chain.forward_kinematics(self._rows(q)).get_matrix()
        return result.reshape(*q.shape[:-1], 4, 4)

    def position(self, q: torch.Tensor) -> torch.Tensor:
        """Return the origin of the link, (..., 3) [m]."""
        return self.pose(q)[..., :3, 3]

    def jacobian(self, q: torch.Tensor) -> torch.Tensor:
        """Return the Jacobian, (..., 6, n), in root axes: linear [m/s], then angular velocity [rad/s] per qd."""
        result: torch.Tensor = self._chain.jacobian(self._rows(q)) @ self._jacobian
        return result.reshape(*q.shape[:-1], 6, q.shape[-1])

    def _rows(self, q: torch.Tensor) -> torch.Tensor:
        """Return the positions of the joints of the chain, (states, joints)."""
        return (q.double() @ self._jacobian.mT + self._offset).reshape(-1, len(self._offset))


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


def _way(robot: Robot, link: str) -> bytes:
    """Return the links and joints from the root to ``link`` as a URDF.

    The parser of pytorch-kinematics refuses some files for elements that are not needed: colours, transmissions.
    """
    path = robot.path_to(link)
    root = etree.Element("robot", name="way")
    for name in (robot.root, *(joint.child for joint in path)):
        etree.SubElement(root, "link", name=name)
    for joint in path:
        joint_element = etree.SubElement(
            root, "joint", name=joint.name, type=joint.type if joint.moves else "fixed"
        )
        etree.SubElement(joint_element, "origin", xyz=_numbers(joint.xyz), rpy=_numbers(joint.rpy))
        etree.SubElement(joint_element, "parent", link=joint.parent)
        etree.SubElement(joint_element, "child", link=joint.child)
        etree.SubElement(joint_element, "axis", xyz=_numbers(joint.axis))
    result: bytes = etree.tostring(root)
    return result


def _numbers(values: Sequence[float]) -> str:
    return " ".join(map(repr, values))
