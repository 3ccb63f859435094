"""Pose and Jacobian of the tip of an arm, by the kinematics of the runtime (``BodyChain``)."""

import copy

import numpy as np
import torch
from torch import Tensor

from spelgen.runtime.body_chain import BodyChain


class TipKinematics:
    """Pose and Jacobian of a link in the frame of the root link, as functions of q, (..., n) [rad, m].

    Results have the dtype of q.

    Args:
        link: name of the link.
        chain: kinematics of the bodies, in double precision.
        carrier: index of the body that carries the link; -1: the root link.
        pose: pose of the link in the frame of this body, (4, 4).

    Attributes:
        joints: displacement per coordinate of each joint that carries the link, (bodies, n); zero for other joints.
    """

    def __init__(self, link: str, chain: BodyChain, carrier: int, pose: np.ndarray) -> None:
        self.link, self._carrier, self._pose = link, carrier, torch.from_numpy(pose)
        carrying = torch.zeros(len(chain.parents)).double()
        if carrier >= 0:
            carrying = chain.carriers[:, carrier]
        self.joints = carrying.unsqueeze(-1) * chain.ratios
        # A module of torch has a fixed dtype. There is a chain per dtype: results have the dtype of q.
        self._chains = {torch.float64: chain, torch.float32: copy.deepcopy(chain).float()}

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
        angular, linear = (axes @ self.joints.to(q)).chunk(2, dim=-2)
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
