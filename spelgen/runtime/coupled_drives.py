"""Rigid bodies whose joints hang on several motors each."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from spelgen.runtime.joints import vector
from spelgen.runtime.parts import Rows
from spelgen.runtime.rigid_body_dynamics import Motion, RigidBodyDynamics, RigidPrepared


class CoupledDrives(RigidBodyDynamics):
    """Friction, its memory and armature are those of motors, which turn by C qd; motors: the rows of C."""

    def __init__(self, motors: Rows, *rigid: Any) -> None:
        super().__init__(*rigid)
        self.motors = nn.Buffer(torch.stack([vector(row) for row in motors]))  # C, (n, n), and its inverse
        self.loads = nn.Buffer(torch.linalg.inv(self.motors))

    def prepare(self) -> RigidPrepared:
        """Return all that depends on the weights alone; holds until they change."""
        prepared = super().prepare()
        return prepared._replace(armature=self.motors.mT @ prepared.armature @ self.motors)

    def _at_drives(self, q: Tensor | Motion, qd: Tensor) -> tuple[Motion, Tensor]:
        """Return the pose with the gravity torque that motors bear, C^-T g, and their speeds."""
        pose: Motion = self.at(q, qd)
        return pose._replace(gravity=pose.gravity @ self.loads), qd @ self.motors.mT

    def friction_torque(self, q: Tensor | Motion, qd: Tensor, *state: Tensor | None) -> Tensor:
        """Return the friction torque C^T f(C qd), (..., n) [Nm, N]; state: see ``FrictionConstants``."""
        return super().friction_torque(*self._at_drives(q, qd), *state) @ self.motors

    def dissipation(self, q: Tensor | Motion, qd: Tensor) -> Tensor:
        """Return D(q, qd), (..., n, n) [Nm s/rad, N s/m]."""
        return self.motors.mT @ super().dissipation(*self._at_drives(q, qd)) @ self.motors

    def memory(self, qd: Tensor) -> Tensor:
        """Return z, (..., n, K), of drives that have long gone this way."""
        return super().memory(qd @ self.motors.mT)

    def memory_rate(self, z: Tensor, qd: Tensor) -> Tensor:
        """Return z', (..., n, K)."""
        return super().memory_rate(z, qd @ self.motors.mT)

    def memory_after(self, z: Tensor, displacement: Tensor) -> Tensor:
        """Return z after joints went one way by (..., n), exactly."""
        return super().memory_after(z, displacement @ self.motors.mT)
