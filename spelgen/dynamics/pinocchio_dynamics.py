"""Rigid bodies by Pinocchio, with armature, friction, inputs and mimic joints.

    M(q) qdd + h(q, qd) + friction(qd) = G tau        with  M = K^T M_joints(K q + offset) K

K is constant, so it adds no velocity terms; it is a permutation unless joints follow others or are locked.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin

from spelgen.dynamics.arrays import Array, on_arrays
from spelgen.dynamics.constraint import Constraint


class PinocchioDynamics:
    """An arm of n coordinates (see ``RigidDynamics``); the model has b joints, the reflected rotors as armature.

    constraint: what its names leave out stands still. friction: torque (..., n) by velocity (..., n).
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
        # coordinates are the model's joints in its order: products with the identity took longer than `aba` itself
        self._same = np.array_equal(self.jacobian, np.eye(self.n)) and not self.offset.any()

    @property
    def n(self) -> int:
        """How many coordinates."""
        return int(self.jacobian.shape[1])

    def mass_matrix(self, q: Array) -> Array:
        """M, (..., n, n) [kg m^2, kg m, kg]."""
        return on_arrays(self._mass, q)

    def nonlinear_effects(self, q: Array, qd: Array) -> Array:
        """Coriolis, centrifugal and gravity torques, (..., n) [Nm, N]."""
        return on_arrays(self._effects, q, qd)

    def gravity(self, q: Array) -> Array:
        """dV/dq, (..., n) [Nm, N]."""
        return on_arrays(lambda q: self._effects(q, np.zeros_like(q)), q)

    def friction_torque(self, q: Array, qd: Array) -> Array:
        """What friction takes, (..., n) [Nm, N]."""
        return on_arrays(lambda _, velocity: self._lost(velocity), q, qd)

    def forward_dynamics(self, q: Array, qd: Array, tau: Array) -> Array:
        """qdd, (..., n), under the inputs tau."""
        return on_arrays(self._forward, q, qd, tau)

    def inverse_dynamics(self, q: Array, qd: Array, qdd: Array) -> Array:
        """The inputs, (..., n), that make qdd; those of a passive joint are the torques that it lacks."""
        return on_arrays(self._inverse, q, qd, qdd)

    def configuration(self, q: np.ndarray) -> np.ndarray:
        """Pinocchio's configuration (..., nq) at q (..., n)."""
        if self._same and self._plain:
            return q
        positions = q @ self.jacobian.T + self.offset
        if self._plain:
            return positions
        configuration: np.ndarray = np.tile(pin.neutral(self.model), (*q.shape[:-1], 1))
        configuration[..., self._lines[:, 0]] = positions[..., self._lines[:, 1]]
        for index, row in self._circles:  # a continuous joint is (cos, sin) in Pinocchio
            configuration[..., index] = np.cos(positions[..., row])
            configuration[..., index + 1] = np.sin(positions[..., row])
        return configuration

    def _by_joint(self, algorithm: Callable[..., np.ndarray], *states: np.ndarray) -> np.ndarray:
        """What the algorithm gives of states (..., nq), (..., nv), ...; it takes one at a time."""
        batch = states[0].shape[:-1]
        if not batch:
            return algorithm(self.model, self.data, *states)
        rows = zip(*(x.reshape(-1, x.shape[-1]) for x in states), strict=True)
        result = np.array([algorithm(self.model, self.data, *row) for row in rows])
        return result.reshape(*batch, *result.shape[1:])

    def _mass(self, q: np.ndarray) -> np.ndarray:
        upper = np.triu(self._by_joint(pin.crba, self.configuration(q)))
        joints = upper + np.triu(upper, 1).swapaxes(-1, -2)  # Pinocchio promises the upper triangle only
        mass: np.ndarray = self.jacobian.T @ joints @ self.jacobian
        return mass

    def _effects(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        effects = self._by_joint(pin.nle, self.configuration(q), qd @ self.jacobian.T)
        result: np.ndarray = effects @ self.jacobian
        return result

    def _lost(self, qd: np.ndarray) -> np.ndarray:
        return np.zeros_like(qd) if self.friction is None else self.friction(qd)

    def _forward(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray) -> np.ndarray:
        force = tau if self.inputs is None else tau @ self.inputs.T
        if self.friction is not None:
            force = force - self.friction(qd)
        if self._same:  # a copy, for Pinocchio writes over what it gave
            return np.array(self._by_joint(pin.aba, self.configuration(q), qd, force))
        return _solved(self._mass(q), force - self._effects(q, qd))

    def _inverse(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        by_joint = (x @ self.jacobian.T for x in (qd, qdd))
        force = self._by_joint(pin.rnea, self.configuration(q), *by_joint) @ self.jacobian + self._lost(qd)
        if self.inputs is None:
            result: np.ndarray = force
            return result
        moved = self.inputs + np.diag(~self.inputs.any(axis=1)).astype(float)
        return _solved(moved, force)


def _solved(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """x (..., n) of matrix (..., n, n) x = right (..., n)."""
    result: np.ndarray = np.linalg.solve(matrix, right[..., None])[..., 0]
    return result
