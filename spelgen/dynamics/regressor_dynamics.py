"""Rigid bodies by their regressor: the dynamics of inertial parameters that least squares found, possible or not."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from torch import Tensor

from spelgen.arm.actuation import Drives
from spelgen.arm.arm import Arm
from spelgen.dynamics.body_regressor import pseudo_inertia
from spelgen.dynamics.bristles import moved_bristles
from spelgen.dynamics.equations import Pose
from spelgen.dynamics.regressor import body_chain
from spelgen.runtime.body_chain import ChainConfiguration
from spelgen.runtime.port_hamiltonian import applied


class RegressorDynamics:
    """An arm of n coordinates with these parameters (see ``RigidDynamics``).

    parameters: (10 B,), as ``regressor`` has them. armature: of the drives, (n,) [kg m^2, kg]. friction: torques (T, n)
    by velocities (T, n) and its memory z (T, n, K), or None. bristle_reach: (n, K) [rad, m], where it has one.
    drives: without, each input is its own joint's torque.
    """

    def __init__(
        self,
        arm: Arm,
        parameters: np.ndarray,
        armature: np.ndarray,
        friction: Callable[[np.ndarray, np.ndarray | None], np.ndarray],
        drives: Drives | None = None,
        bristle_reach: np.ndarray | None = None,
    ) -> None:
        self.chain, self.friction = body_chain(arm), friction
        by_body = torch.from_numpy(parameters).double().reshape(-1, 10)
        self.inertia = torch.block_diag(*pseudo_inertia(by_body))
        self.armature = torch.tensor(armature, dtype=torch.float64)
        alone = np.eye(len(armature))
        reach = alone[:, :0] if bristle_reach is None else bristle_reach
        self.bristle_reach = torch.from_numpy(reach)
        inputs, motors = drives or Drives(alone, alone)
        self.inputs, self.motors = torch.from_numpy(inputs), torch.from_numpy(motors)

    @property
    def n(self) -> int:
        """How many coordinates."""
        return len(self.armature)

    @property
    def elements(self) -> int:
        """K, of friction's memory at a joint."""
        return self.bristle_reach.shape[1]

    def mass_matrix(self, q: Tensor) -> Tensor:
        """M, (..., n, n) [kg m^2, kg m, kg]."""
        return self.pose_at(q).mass

    def gravity(self, q: Tensor) -> Tensor:
        """dV/dq, (..., n) [Nm, N]."""
        return self.nonlinear_effects(q, torch.zeros_like(q))

    def nonlinear_effects(self, q: Tensor, qd: Tensor) -> Tensor:
        """Coriolis, centrifugal and gravity torques, (..., n) [Nm, N]."""
        chain, momenta = self._bodies(q)
        return applied(momenta, self.chain.accelerations(chain, qd))

    def _bodies(self, q: Tensor) -> tuple[ChainConfiguration, Tensor]:
        """Return the bodies' frames as points, and their momenta by joint velocity, (..., n, 12 bodies)."""
        chain = self.chain.forward(q, torch.eye(len(self.inertia)).to(q))
        jacobian = torch.unflatten(self.chain.ratios.mT @ chain.jacobian, -1, (3, -1))
        return chain, (jacobian @ self.inertia).flatten(-2)

    def friction_torque(self, q: Tensor, qd: Tensor, z: Tensor | None = None) -> Tensor:
        """What friction takes, and what the measured torque shows without any, (..., n) [Nm, N]."""
        past = z.numpy() if z is not None and self.elements else None
        return torch.from_numpy(self.friction(qd.numpy(), past))

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor, z: Tensor | None = None) -> Tensor:
        """qdd, (..., n), under the inputs tau."""
        pose = self.pose_at(q)
        force = pose.force(qd, tau, z).unsqueeze(-1)  # one column: vectors would need the same batch
        qdd: Tensor = torch.linalg.solve(pose.mass, force)
        return qdd.squeeze(-1)

    def inverse_dynamics(self, q: Tensor, qd: Tensor, qdd: Tensor, z: Tensor | None = None) -> Tensor:
        """The inputs, (..., n), that make qdd; those of a passive joint are the torques that it lacks."""
        passive = (self.inputs == 0).all(dim=1).double()
        inverse: Tensor = torch.linalg.inv(self.inputs + torch.diag(passive))
        return self.joint_torque(q, qd, qdd, z) @ inverse.mT

    def joint_torque(self, q: Tensor, qd: Tensor, qdd: Tensor, z: Tensor | None = None) -> Tensor:
        """What all joints, passive ones too, need for qdd, (..., n) [Nm, N]."""
        pose = self.pose_at(q)
        return applied(pose.mass, qdd) - pose.force(qd, torch.zeros_like(qdd), z)

    def pose_at(self, q: Tensor) -> Pose:
        """Return the equations of motion at q, (T, n), see `equations.poses`."""
        chain, momenta = self._bodies(q)

        def force(qd: Tensor, tau: Tensor, z: Tensor | None) -> Tensor:
            bias = applied(momenta, self.chain.accelerations(chain, qd))
            return tau @ self.inputs.mT - bias - self.friction_torque(q, qd, z)

        rotors = self.motors.mT @ torch.diag(self.armature) @ self.motors
        mass = momenta @ chain.jacobian.mT @ self.chain.ratios + rotors
        return Pose(mass, force, partial(self.friction_torque, q))

    def memory(self, qd: Tensor) -> Tensor:
        """z, (..., n, K), of drives that have long gone this way."""
        return (qd @ self.motors.mT.to(qd)).sign().unsqueeze(-1) * self.bristle_reach

    def memory_after(self, z: Tensor, displacement: Tensor) -> Tensor:
        """z after joints went one way by (..., n)."""
        moved = displacement @ self.motors.mT.to(displacement)
        return moved_bristles(z, moved.unsqueeze(-1), self.bristle_reach)
