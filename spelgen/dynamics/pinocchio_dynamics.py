"""Rigid bodies by Pinocchio, with armature, friction, inputs and mimic joints.

    M(q) qdd + h(q, qd) + friction(qd) = G tau        with  M = K^T M_joints(K q + offset) K

K is constant, so it adds no velocity terms; it is a permutation unless joints follow others or are locked.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
import pinocchio as pin

from spelgen.dynamics.arrays import by_state
from spelgen.dynamics.constraint import Constraint

Array = TypeVar("Array")
"""numpy.ndarray or torch.Tensor: what is returned is of the kind of what is given."""


class PinocchioDynamics:
    """An arm of n coordinates (see ``RigidDynamics``); the model has b joints, the reflected rotors as armature.

    constraint: what its names leave out stands still. friction: torque (n,) by velocity (n,).
    inputs: G, (n, n); without, each input is its own joint's torque.
    """

    def __init__(
        self,
        model: pin.Model,
        constraint: Constraint,
        friction: Callable[[np.ndarray], np.ndarray] | None = None,
        inputs: np.ndarray | None = None,
    ) -> None:
        self.model, self.data = model, model.createData()
        self.friction, self.inputs = friction, inputs
        self.jacobian, self.offset = np.zeros((model.nv, constraint.jacobian.shape[1])), np.zeros(model.nv)
        circles, lines = list[tuple[int, int]](), list[tuple[int, int]]()
        for name, row, offset in zip(constraint.names, constraint.jacobian, constraint.offset, strict=True):
            joint = model.joints[model.getJointId(name)]
            self.jacobian[joint.idx_v], self.offset[joint.idx_v] = row, offset
            (lines if joint.nq == 1 else circles).append((joint.idx_q, joint.idx_v))
        # where a joint's position stands in a configuration, and in a velocity
        self._circles = circles
        self._lines = np.array(lines, dtype=np.int64).reshape(-1, 2)
        self._plain = not circles and model.nq == model.nv == len(lines)
        identity = np.array_equal(self.jacobian.T @ self.jacobian, np.eye(self.n))
        self._direct = model.nv == self.n and identity and not self.offset.any()

    @property
    def n(self) -> int:
        """How many coordinates."""
        return int(self.jacobian.shape[1])

    def mass_matrix(self, q: Array) -> Array:
        """M, (..., n, n) [kg m^2, kg m, kg]."""
        return by_state(self._mass, q)

    def nonlinear_effects(self, q: Array, qd: Array) -> Array:
        """Coriolis, centrifugal and gravity torques, (..., n) [Nm, N]."""
        return by_state(self._effects, q, qd)

    def gravity(self, q: Array) -> Array:
        """dV/dq, (..., n) [Nm, N]."""
        return by_state(lambda each: self._effects(each, np.zeros_like(each)), q)

    def friction_torque(self, q: Array, qd: Array) -> Array:
        """What friction takes, (..., n) [Nm, N]."""
        return by_state(lambda _, each: self._lost(each), q, qd)

    def forward_dynamics(self, q: Array, qd: Array, tau: Array) -> Array:
        """qdd, (..., n), under the inputs tau."""
        return by_state(self._forward, q, qd, tau)

    def inverse_dynamics(self, q: Array, qd: Array, qdd: Array) -> Array:
        """The inputs, (..., n), that make qdd; those of a passive joint are the torques that it lacks."""
        return by_state(self._inverse, q, qd, qdd)

    def configuration(self, q: np.ndarray) -> np.ndarray:
        """Pinocchio's configuration (nq,) at q (n,)."""
        positions = self.jacobian @ q + self.offset
        if self._plain:
            return positions
        configuration: np.ndarray = pin.neutral(self.model)
        configuration[self._lines[:, 0]] = positions[self._lines[:, 1]]
        for place, row in self._circles:  # a continuous joint is (cos, sin) in Pinocchio
            configuration[place : place + 2] = np.cos(positions[row]), np.sin(positions[row])
        return configuration

    def _mass(self, q: np.ndarray) -> np.ndarray:
        upper = np.triu(pin.crba(self.model, self.data, self.configuration(q)))
        joints = upper + np.triu(upper, 1).T  # Pinocchio promises the upper triangle only
        mass: np.ndarray = self.jacobian.T @ joints @ self.jacobian
        return mass

    def _effects(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        effects = pin.nle(self.model, self.data, self.configuration(q), self.jacobian @ qd)
        found: np.ndarray = self.jacobian.T @ effects
        return found

    def _lost(self, qd: np.ndarray) -> np.ndarray:
        return np.zeros_like(qd) if self.friction is None else self.friction(qd)

    def _forward(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray) -> np.ndarray:
        force = tau if self.inputs is None else self.inputs @ tau
        if self.friction is not None:
            force = force - self.friction(qd)
        if not self._direct:
            return np.linalg.solve(self._mass(q), force - self._effects(q, qd))
        by_joint = (self.jacobian @ x for x in (qd, force))
        found: np.ndarray = self.jacobian.T @ pin.aba(self.model, self.data, self.configuration(q), *by_joint)
        return found

    def _inverse(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        velocity, acceleration = (self.jacobian @ x for x in (qd, qdd))
        needed = pin.rnea(self.model, self.data, self.configuration(q), velocity, acceleration)
        force = self.jacobian.T @ needed + self._lost(qd)
        if self.inputs is None:
            return force
        moved = self.inputs + np.diag(~self.inputs.any(axis=1)).astype(float)
        return np.linalg.solve(moved, force)
