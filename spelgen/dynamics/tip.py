"""Pose and Jacobian of the tip of an arm, by pytorch-kinematics."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from scipy.spatial.transform import Rotation

from spelgen.dynamics.constraint import mimic_constraint
from spelgen.urdf.read import read_urdf
from spelgen.urdf.robot import Robot, UrdfJoint

if TYPE_CHECKING:
    from pytorch_kinematics import SerialChain


class TipKinematics:
    """Pose and Jacobian of a link in the frame of the root link, as functions of q, (..., n) [rad, m].

    Mimic joints move with their coordinates; all other joints are at zero. Angles near a multiple of pi/2 are not
    rounded to it, unlike in a `Chain`. Results have the dtype of q.

    Args:
        robot: the URDF.
        joints: names of the coordinates, in the order of q.
        link: name of the link.
    """

    def __init__(self, robot: Robot, joints: Sequence[str], link: str) -> None:
        self.link = link
        path = robot.path_to(link)
        # A chain of pytorch-kinematics has a fixed dtype. There is a chain per dtype: results have the dtype of q.
        self._chains = {
            dtype: _serial_chain(robot.root, path, dtype) for dtype in (torch.float64, torch.float32)
        }
        constraint = mimic_constraint(robot, joints)
        rows = [constraint.names.index(joint.name) for joint in path if joint.moves]
        # The J moving joints on the path to the link include mimic joints. Their positions are _jacobian q + _offset,
        # with _jacobian (J, n) and _offset (J,).
        self._jacobian = torch.from_numpy(constraint.jacobian[rows])
        self._offset = torch.from_numpy(constraint.offset[rows])
        # A coordinate that does not move the link is an error: it is probably a mistake of the caller.
        missing = [name for name, column in zip(joints, self._jacobian.T, strict=True) if not column.any()]
        if missing:
            raise ValueError(f"the joints {', '.join(missing)} do not lead to {link}")

    def pose(self, q: torch.Tensor) -> torch.Tensor:
        """Return the pose of the link at q: the homogeneous transform from the link to the root frame, (..., 4, 4)."""
        poses: torch.Tensor = self._chains[q.dtype].forward_kinematics_tensor(
            self._positions(q), analytical_grad=False
        )[-1]
        return poses.reshape(*q.shape[:-1], 4, 4)

    def position(self, q: torch.Tensor) -> torch.Tensor:
        """Return the position of the link's origin in the root frame, (..., 3) [m]."""
        return self.pose(q)[..., :3, 3]

    def jacobian(self, q: torch.Tensor) -> torch.Tensor:
        """Return the Jacobian of the link, (..., 6, n), in root axes: rows 0-2 linear, 3-5 angular velocity."""
        jacobian: torch.Tensor = self._chains[q.dtype].jacobian_tensor(
            self._positions(q)
        ) @ self._jacobian.to(q)
        return jacobian.reshape(*q.shape[:-1], 6, q.shape[-1])

    def _positions(self, q: torch.Tensor) -> torch.Tensor:
        """Return the positions of all joints on the path to the link, (S, joints) [rad, m], of S states q, (..., n)."""
        return (q @ self._jacobian.to(q).mT + self._offset.to(q)).reshape(-1, len(self._offset))


def _serial_chain(root: str, path: Sequence[UrdfJoint], dtype: torch.dtype) -> SerialChain:
    """Return the chain of pytorch-kinematics for a path of joints from the root link.

    The frames are built from spelgen's values of the URDF, since the URDF parser of pytorch-kinematics rounds to
    float32.
    """
    import pytorch_kinematics as pk  # pytorch_kinematics is imported here: it imports matplotlib, which takes long.
    from pytorch_kinematics.frame import Frame, Joint, Link

    first = last = Frame(root, Link(root), Joint())
    for joint in path:
        kind = "fixed"
        if joint.moves:
            kind = "prismatic" if joint.type == "prismatic" else "revolute"
        axis = torch.tensor(joint.axis, dtype=torch.float64)
        rotation = Rotation.from_euler("xyz", joint.rpy).as_matrix()
        offset = pk.Transform3d(rot=rotation, pos=joint.xyz, dtype=dtype)
        frame = Frame(
            joint.child, Link(joint.child), Joint(joint.name, offset, kind, axis / axis.norm(), dtype)
        )
        last.add_child(frame)
        last = frame
    return pk.SerialChain(pk.Chain(first, dtype=dtype), last.name, dtype=dtype)


def tip_kinematics(
    arm: Any, link: str | None = None, *, joints: Sequence[str] | None = None
) -> TipKinematics:
    """Return the kinematics of a link, by default the tip of the arm.

    Args:
        arm: result of ``load_arm``, or the path of a URDF, together with ``joints``.
        link: name of the link; None: the tip of the arm, or the result of `Robot.last_link` if no tip is specified.
        joints: names of the coordinates, if ``arm`` is a path.

    Raises:
        ValueError: a joint does not move the link, or ``arm`` is a path and ``joints`` is None.
    """
    if isinstance(arm, str | Path):
        robot, names = read_urdf(Path(arm)), list(joints or ())
    else:
        robot, names = arm.robot, arm.chain.joint_names
        link = link or arm.tip
    if not names:
        raise ValueError("no joints are named")
    return TipKinematics(robot, names, link or robot.last_link(names))
