"""Pose and Jacobian of the tip of an arm, by the kinematics of the runtime (``BodyChain``)."""

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from spelgen.arm.configured_arm import Arm, load_arm
from spelgen.dynamics.regressor_dynamics import body_chain
from spelgen.dynamics.tip_frame import Tip, tip_frame


class TipKinematics:
    """Pose and Jacobian of a link in the frame of the root link, as functions of q, (..., n) [rad, m].

    Mimic joints move with their coordinates; all other joints are at zero. Angles near a multiple of pi/2 are not
    rounded to it, unlike in a `Chain`. Results have the dtype of q.

    tip: frame of the link. Raises ValueError for a coordinate that does not move the link.
    """

    def __init__(self, tip: Tip) -> None:
        self.link = tip.link
        self._carrier, self._pose = tip.carrier, torch.from_numpy(tip.pose)
        # A module of torch has a fixed dtype. There is a chain per dtype: results have the dtype of q.
        self._chains = {dtype: body_chain(tip.chain).to(dtype) for dtype in (torch.float64, torch.float32)}
        chain = self._chains[torch.float64]
        # `_joints`, (bodies, n): displacement per coordinate of each joint that carries the link; other rows are zero.
        carrying = (
            chain.carriers[:, tip.carrier] if tip.carrier >= 0 else torch.zeros(len(chain.parents)).double()
        )
        self._joints = carrying.unsqueeze(-1) * chain.ratios
        # A coordinate that does not move the link is an error: it is probably a mistake of the caller.
        names = zip(tip.chain.joint_names, self._joints.T, strict=True)
        missing = [name for name, column in names if not column.any()]
        if missing:
            raise ValueError(f"the joints {', '.join(missing)} do not lead to {tip.link}")

    def pose(self, q: Tensor) -> Tensor:
        """Return the pose of the link at q: the homogeneous transform from the link to the root frame, (..., 4, 4)."""
        return self._pose_and_axes(q)[0]

    def position(self, q: Tensor) -> Tensor:
        """Return the position of the link's origin in the root frame, (..., 3) [m]."""
        return self.pose(q)[..., :3, 3]

    def jacobian(self, q: Tensor) -> Tensor:
        """Return the Jacobian of the link, (..., 6, n): its linear, then its angular velocity per qd, in root axes."""
        pose, axes = self._pose_and_axes(q)
        # `linear` is the velocity of the point of the link at the origin of the root frame.
        angular, linear = (axes @ self._joints.to(q)).chunk(2, dim=-2)
        moment = torch.linalg.cross(angular, pose[..., :3, 3:], dim=-2)
        return torch.cat([linear + moment, angular], dim=-2)

    def _pose_and_axes(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the pose of the link, (..., 4, 4), and the twists of all joints per unit rate, (..., 6, bodies)."""
        chain = self._chains[q.dtype]
        # `chain.forward` returns the frames of the bodies times four given points; the columns of the identity as
        # points give the frames.
        configuration = chain.forward(q, torch.eye(4 * len(chain.parents)).to(q))
        frames = torch.cat([configuration.place, configuration.mass], dim=-3)
        return frames[..., self._carrier, :] @ self._pose.to(q), configuration.axes


def tip_kinematics(
    arm: Arm | Path | str, link: str | None = None, *, joints: Sequence[str] | None = None
) -> TipKinematics:
    """Return the kinematics of a link, by default the tip of the arm.

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
    return TipKinematics(tip_frame(arm, link))
