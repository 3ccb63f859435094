"""A URDF as Pinocchio reads it, by itself, in place of an emitted module."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from spelgen.settings.settings import load_settings
from spelgen.urdf.actuation import derive_actuation
from spelgen.urdf.read import read_urdf

FRICTION_VELOCITY = 0.05  # [rad/s, m/s] width of the tanh in place of the jump of a URDF's Coulomb friction


class PinocchioDynamics:
    """A URDF's arm of n joints, all others locked at zero, with velocities where an emitted module has
    momenta.
    """

    def __init__(self, urdf: Path, joints: Sequence[str]) -> None:
        import pinocchio as pin  # an extra: everything else here works without

        robot, settings = read_urdf(urdf), load_settings(urdf)
        coupled = [joint.name for joint in robot.joints if joint.mimic and joint.mimic.joint in joints]
        if coupled:
            raise ValueError(f"mimic joints are not supported here: {', '.join(coupled)}")
        whole = pin.buildModelFromUrdf(str(urdf))
        locked = [i for i in range(1, whole.njoints) if whole.names[i] not in joints]
        self._pin: Any = pin
        self._model = pin.buildReducedModel(whole, locked, pin.neutral(whole))
        if sorted(self._model.names[1:]) != sorted(joints) or self._model.nv != len(joints):
            raise ValueError(f"Pinocchio sees the joints {', '.join(self._model.names[1:])}")
        self._model.gravity.linear = np.array(settings.gravity)
        self._data = self._model.createData()
        found = [self._model.joints[self._model.getJointId(name)] for name in joints]
        self._order = np.array([joint.idx_v for joint in found])
        self._places = [(joint.idx_q, joint.nq) for joint in found]
        self._inputs = derive_actuation(robot, settings, joints).matrix()
        self._damping, self._friction = self._model.damping[self._order], self._model.friction[self._order]

    def momentum(self, q: torch.Tensor, qd: torch.Tensor, prepared: None = None) -> torch.Tensor:
        return qd

    def velocity(self, q: torch.Tensor, p: torch.Tensor, prepared: None = None) -> torch.Tensor:
        return p

    def prepare(self) -> None:
        """Nothing: there are no weights."""

    def rates(
        self, q: torch.Tensor, p: torch.Tensor, tau: torch.Tensor | None, prepared: None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Rates of q and qd, each (W, n), under the torques tau (W, n)."""
        qd = p.numpy()
        force = -self._losses(qd) if tau is None else tau.numpy() @ self._inputs.T - self._losses(qd)
        qdd = np.empty_like(qd)
        position, velocity, effort = (
            self._configurations(q.numpy()),
            self._permuted(qd),
            self._permuted(force),
        )
        for row in range(len(q)):
            solved = self._pin.aba(self._model, self._data, position[row], velocity[row], effort[row])
            qdd[row] = solved[self._order]
        return p, torch.from_numpy(qdd)

    def mass_matrix(self, q: torch.Tensor) -> torch.Tensor:
        """M (T, n, n) [kg m^2, kg m, kg]."""
        order = np.ix_(self._order, self._order)
        upper = [self._pin.crba(self._model, self._data, at)[order] for at in self._configurations(q.numpy())]
        full = np.array([np.where(m == 0, m.T, m) for m in upper])  # crba fills one triangle in its own order
        return torch.from_numpy(full)

    def gravity(self, q: torch.Tensor) -> torch.Tensor:
        """dV/dq (T, n) [Nm, N]."""
        still = torch.zeros_like(q)
        return torch.from_numpy(self._joint_torque(q, still, still))

    def inverse_dynamics(self, q: torch.Tensor, qd: torch.Tensor, qdd: torch.Tensor) -> torch.Tensor:
        """Inputs (T, n); those of a passive joint are the torques that it lacks."""
        moved = self._inputs + np.diag(~self._inputs.any(axis=1)).astype(float)
        return torch.from_numpy(np.linalg.solve(moved, self._joint_torque(q, qd, qdd).T).T)

    def _joint_torque(self, q: torch.Tensor, qd: torch.Tensor, qdd: torch.Tensor) -> np.ndarray:
        position, velocity = self._configurations(q.numpy()), self._permuted(qd.numpy())
        acceleration = self._permuted(qdd.numpy())
        tau = np.empty(qd.shape)
        for row in range(len(q)):
            needed = self._pin.rnea(self._model, self._data, position[row], velocity[row], acceleration[row])
            tau[row] = needed[self._order]
        return tau + self._losses(qd.numpy())

    def _losses(self, qd: np.ndarray) -> np.ndarray:
        return self._damping * qd + self._friction * np.tanh(qd / FRICTION_VELOCITY)

    def _permuted(self, values: np.ndarray) -> np.ndarray:
        """Our joint order -> Pinocchio's."""
        permuted = np.empty(values.shape)
        permuted[:, self._order] = values
        return permuted

    def _configurations(self, q: np.ndarray) -> np.ndarray:
        """Pinocchio's configurations: a continuous joint is (cos, sin) there."""
        configurations = np.empty((len(q), self._model.nq))
        for (start, size), angle in zip(self._places, q.T, strict=True):
            configurations[:, start] = angle if size == 1 else np.cos(angle)
            if size == 2:
                configurations[:, start + 1] = np.sin(angle)
        return configurations
