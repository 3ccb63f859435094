"""Rigid bodies by their regressor: the dynamics of inertial parameters that least squares found, possible or not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from spelgen.arm.actuation import Drives
from spelgen.arm.arm import Arm
from spelgen.dynamics.arrays import Array, like
from spelgen.dynamics.pose import Pose
from spelgen.dynamics.rigid_bodies import RigidBodies
from spelgen.runtime.bristles import moved_bristles


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
        self.bodies, self.armature, self.friction = RigidBodies(arm, parameters), armature, friction
        self.bristle_reach = None if bristle_reach is None else torch.from_numpy(bristle_reach)
        alone = np.eye(len(armature))
        self.inputs, self.motors = drives or Drives(alone, alone)

    @property
    def n(self) -> int:
        """How many coordinates."""
        return len(self.armature)

    @property
    def elements(self) -> int:
        """K, of friction's memory at a joint."""
        return 0 if self.bristle_reach is None else self.bristle_reach.shape[1]

    def mass_matrix(self, q: Array) -> Array:
        """M, (..., n, n) [kg m^2, kg m, kg]."""
        return self._by_rows(lambda position, _: self._mass_and_bias(position, 0 * position)[0], q)

    def gravity(self, q: Array) -> Array:
        """dV/dq, (..., n) [Nm, N]."""
        return self._by_rows(lambda position, _: self._mass_and_bias(position, 0 * position)[1], q)

    def nonlinear_effects(self, q: Array, qd: Array) -> Array:
        """Coriolis, centrifugal and gravity torques, (..., n) [Nm, N]."""
        return self._by_rows(lambda position, speed, _: self._mass_and_bias(position, speed)[1], q, qd)

    def friction_torque(self, q: Array, qd: Array, z: Array | None = None) -> Array:
        """What friction takes, and what the measured torque shows without any, (..., n) [Nm, N]."""
        return self._by_rows(lambda _, speed, past: self.friction(speed, past), q, qd, z=z)

    def forward_dynamics(self, q: Array, qd: Array, tau: Array, z: Array | None = None) -> Array:
        """qdd, (..., n), under the inputs tau."""
        return self._by_rows(self._forward, q, qd, tau, z=z)

    def pose_at(self, q: torch.Tensor) -> Pose:
        """Return the equations of motion at q, (T, n), see `pose.poses`."""
        mass, bias_at = self.bodies.at(q)
        inputs = torch.from_numpy(self.inputs)

        def friction(qd: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
            past = z.numpy() if self.elements else None
            return torch.from_numpy(self.friction(qd.numpy(), past))

        def force(qd: torch.Tensor, tau: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
            return tau @ inputs.mT - bias_at(qd) - friction(qd, z)

        return Pose(mass + torch.from_numpy(self._reflected()), force, friction)

    def memory(self, qd: torch.Tensor) -> torch.Tensor:
        """z, (..., n, K), of drives that have long gone this way."""
        assert self.bristle_reach is not None
        return self._driven(qd).sign().unsqueeze(-1) * self.bristle_reach

    def memory_after(self, z: torch.Tensor, displacement: torch.Tensor) -> torch.Tensor:
        """z after joints went one way by (..., n)."""
        assert self.bristle_reach is not None
        return moved_bristles(z, self._driven(displacement), self.bristle_reach)

    def inverse_dynamics(self, q: Array, qd: Array, qdd: Array, z: Array | None = None) -> Array:
        """The inputs, (..., n), that make qdd; those of a passive joint are the torques that it lacks."""
        return self._by_rows(self._inverse, q, qd, qdd, z=z)

    def joint_torque(self, q: Array, qd: Array, qdd: Array, z: Array | None = None) -> Array:
        """What all joints, passive ones too, need for qdd, (..., n) [Nm, N]."""
        return self._by_rows(self._torque, q, qd, qdd, z=z)

    def _driven(self, joints: torch.Tensor) -> torch.Tensor:
        """Of the drives, (..., n)."""
        return joints @ torch.from_numpy(self.motors.T).to(joints)

    def _mass_and_bias(self, q: np.ndarray, qd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """M, (T, n, n), what the drives add included, and the bodies' torques at steady qd, (T, n)."""
        mass, bias = self.bodies.mass_and_bias(q, qd)
        return mass + self._reflected(), bias

    def _reflected(self) -> np.ndarray:
        """What the drives add to M, (n, n)."""
        added: np.ndarray = self.motors.T @ (self.armature[:, None] * self.motors)
        return added

    def _forward(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, z: np.ndarray | None) -> np.ndarray:
        mass, bias = self._mass_and_bias(q, qd)
        force = tau @ self.inputs.T - bias - self.friction(qd, z)
        return np.linalg.solve(mass, force[..., None])[..., 0]

    def _torque(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, z: np.ndarray | None) -> np.ndarray:
        mass, bias = self._mass_and_bias(q, qd)
        result: np.ndarray = (mass @ qdd[..., None])[..., 0] + bias + self.friction(qd, z)
        return result

    def _inverse(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, z: np.ndarray | None) -> np.ndarray:
        force = self._torque(q, qd, qdd, z)
        moved = self.inputs + np.diag(~self.inputs.any(axis=1)).astype(float)
        return np.linalg.solve(moved, force.T).T

    def _by_rows(self, function: Callable[..., np.ndarray], *states: Array, z: Array | None = None) -> Array:
        """``function`` of states (T, n), and z (T, n, K) or None, for states (..., n)."""
        rows = np.broadcast_arrays(*(np.asarray(x) for x in states))
        past = None if z is None else np.asarray(z).reshape(-1, self.n, np.asarray(z).shape[-1])
        result = function(*(x.reshape(-1, self.n) for x in rows), past)
        return like(result.reshape(*rows[0].shape[:-1], *result.shape[1:]), states[0])
