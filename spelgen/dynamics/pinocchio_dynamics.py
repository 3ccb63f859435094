"""Dynamics of rigid bodies by Pinocchio, with armature, friction, an input matrix and mimic joints.

    M(q) qdd + h(q, qd) + friction(qd) = G tau        with  M = K^T M_joints(K q + offset) K

M_joints is Pinocchio's mass matrix of all joints, h the Coriolis, centrifugal and gravity torque, G the input matrix. K
maps the coordinates q to the positions of all joints (see `constraint`). K is constant, so it adds no velocity terms.
K is a permutation unless there are mimic or locked joints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from lxml import etree

from spelgen.arm.actuation import derive_actuation
from spelgen.dynamics.constraint import Constraint, mimic_constraint
from spelgen.dynamics.friction import joint_friction
from spelgen.settings.settings import load_settings
from spelgen.urdf.document import read_document
from spelgen.urdf.read import read_urdf


def _takes_tensors(method: Callable[..., np.ndarray]) -> Callable[..., Any]:
    """Decorate a method of NumPy arrays, (..., n), so that it accepts tensors, too, and broadcasts batch dimensions."""

    @wraps(method)
    def on_arrays(self: PinocchioDynamics, *states: Any) -> object:
        first = states[0]
        # Broadcasting is skipped for single states, which integrators pass: it would take longer than the dynamics.
        if isinstance(first, np.ndarray) and first.ndim == 1:
            return method(self, *states)
        result = method(self, *np.broadcast_arrays(*map(np.asarray, states)))
        if isinstance(first, np.ndarray):
            return result
        # The result gets its type by `new_tensor` of an argument, because this file must be importable without torch.
        return first.new_tensor(result)

    return on_arrays


class PinocchioDynamics:
    """Dynamics of an arm of n coordinates (see ``RigidDynamics``).

    Args:
        model: Pinocchio model of b joints, with the rotor inertia as armature.
        constraint: joint positions as a function of the coordinates (mimic joints); joints of the model that are not
            named in it are locked.
        friction: function of the velocity (..., n) that returns the friction torque (..., n); None: no friction.
        inputs: input matrix G, (n, n); None: each input is the torque of its joint.
    """

    def __init__(
        self,
        model: pin.Model,
        constraint: Constraint,
        friction: Callable[[np.ndarray], np.ndarray] | None = None,
        inputs: np.ndarray | None = None,
    ) -> None:
        self.model, self.data = model, model.createData()
        self.friction: Callable[[np.ndarray], np.ndarray] = friction or np.zeros_like
        self.inputs = np.eye(constraint.jacobian.shape[1]) if inputs is None else inputs
        order = [model.joints[model.getJointId(name)].idx_v for name in constraint.names]
        self.jacobian, self.offset = np.zeros((model.nv, len(self.inputs))), np.zeros(model.nv)
        self.jacobian[order], self.offset[order] = constraint.jacobian, constraint.offset
        # Products with the constraint's Jacobian would take longer than Pinocchio's `aba`: they are skipped if it is
        # the identity.
        self._same = np.array_equal(self.jacobian, np.eye(self.n)) and not self.offset.any()

    @property
    def n(self) -> int:
        """Number of coordinates."""
        return int(self.jacobian.shape[1])

    @_takes_tensors
    def mass_matrix(self, q: np.ndarray) -> np.ndarray:
        """Return the mass matrix M, (..., n, n) [kg m^2, kg m, kg]."""
        return np.asarray(self.jacobian.T @ self._batched(pin.crba, self.configuration(q)) @ self.jacobian)

    @_takes_tensors
    def nonlinear_effects(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        """Return Coriolis, centrifugal and gravity torque, (..., n) [Nm, N]."""
        effects = self._batched(pin.nle, self.configuration(q), qd @ self.jacobian.T)
        return effects @ self.jacobian

    @_takes_tensors
    def gravity(self, q: np.ndarray) -> np.ndarray:
        """Return the gravity torque dV/dq, (..., n) [Nm, N]."""
        return np.asarray(self.nonlinear_effects(q, np.zeros_like(q)))

    @_takes_tensors
    def friction_torque(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        """Return the friction torque, (..., n) [Nm, N], at velocities qd, (..., n); q has no effect."""
        return self.friction(qd)

    @_takes_tensors
    def forward_dynamics(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Return the accelerations qdd, (..., n) [rad/s^2, m/s^2], under the inputs tau, (..., n)."""
        force = tau @ self.inputs.T - self.friction(qd)
        if self._same:  # The result of `aba` is copied, because Pinocchio overwrites it in the next call.
            return np.array(self._batched(pin.aba, self.configuration(q), qd, force))
        # `aba` cannot solve the equations with mimic joints, K^T M_joints K qdd = force, so M is computed.
        force = force - self.nonlinear_effects(q, qd)
        return np.linalg.solve(self.mass_matrix(q), force[..., None])[..., 0]

    @_takes_tensors
    def inverse_dynamics(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """Return the inputs tau, (..., n), that give the accelerations qdd, (..., n).

        A passive joint has no input: its element is the torque that a motor at the joint would need.
        """
        speeds, rates = qd @ self.jacobian.T, qdd @ self.jacobian.T
        torque = self._batched(pin.rnea, self.configuration(q), speeds, rates) @ self.jacobian
        torque = torque + self.friction(qd)
        # The row of a passive joint in G is zero, which makes G singular. It is replaced by the row of the identity.
        passive = np.diag(~self.inputs.any(axis=1))
        return np.linalg.solve(self.inputs + passive, torque[..., None])[..., 0]

    def configuration(self, q: np.ndarray) -> np.ndarray:
        """Return Pinocchio's configuration vector, (..., nq), at the coordinates q, (..., n) [rad, m]."""
        if not self._same:
            q = q @ self.jacobian.T + self.offset
        if self.model.nq == self.model.nv:
            return q
        # Pinocchio represents a continuous joint by (cos q, sin q). Planar and floating joints are not coordinates and
        # remain at the neutral configuration.
        neutral = pin.neutral(self.model)
        found = self._batched(lambda model, _, position: pin.integrate(model, neutral, position), q)
        return found.reshape(*q.shape[:-1], self.model.nq)

    def _batched(self, algorithm: Callable[..., np.ndarray], *states: np.ndarray) -> np.ndarray:
        """Return the results of an algorithm of Pinocchio, such as `rnea`, for each state of a batch.

        states: arguments of the algorithm after model and data, (..., nq) or (..., nv).
        """
        batch = states[0].shape[:-1]
        if not batch:
            return algorithm(self.model, self.data, *states)
        rows = zip(*(x.reshape(-1, x.shape[-1]) for x in states), strict=True)
        result = np.array([algorithm(self.model, self.data, *row) for row in rows])
        return result.reshape(*batch, *result.shape[1:])


def urdf_dynamics(urdf: Path, joints: Sequence[str], *, drives: bool = False) -> PinocchioDynamics:
    """Return the dynamics of the arm in a URDF that Pinocchio has parsed, as a reference for spelgen's own parser.

    The URDF defines inertials, damping and friction. The settings file of the URDF defines gravity and the input
    matrix. Raises the errors of Pinocchio if it cannot read the URDF.

    Args:
        urdf: path of the URDF.
        joints: names of the coordinates; their mimic joints move, too, and all other joints are locked at zero.
        drives: True: for joints in the settings file, use rotor inertia and friction of the drive from this file, in
            place of damping and friction of the URDF.
    """
    robot, settings = read_urdf(urdf), load_settings(urdf)
    # Pinocchio parses the file itself, so the result is an independent reference for spelgen's own parser.
    model = pin.buildModelFromXML(etree.tostring(read_document(urdf).root, encoding="unicode"))
    model.gravity.linear = np.array(settings.gravity)
    constraint = mimic_constraint(robot, joints)
    missing = [name for name in constraint.names if not model.existJointName(name)]
    if missing:
        raise ValueError(f"Pinocchio sees no joint {', '.join(missing)}")
    motors = derive_actuation(robot, settings, joints).drives()
    # Friction of the URDF acts at the joints; friction of the settings acts at the motors, whose velocities are C qd.
    by_joint, speeds = (settings.joints, motors.speeds) if drives else ({}, None)
    for name in joints:
        if name in by_joint:
            model.armature[model.joints[model.getJointId(name)].idx_v] = by_joint[name].armature
    moving = [robot.joint[name] for name in joints]
    # 0.05 rad/s or m/s is the width of the tanh that replaces the sign of the velocity in dry friction.
    friction = joint_friction(moving, by_joint, 0.05, speeds)
    return PinocchioDynamics(model, constraint, friction, motors.inputs)


def drives_known(urdf: Path, joints: Sequence[str]) -> bool:
    """Return True if the settings file of a URDF specifies rotor inertia or friction of one of the given joints."""
    drives = load_settings(urdf).joints
    return any(x.rotor_inertia or x.viscous or any(x.coulomb) for k, x in drives.items() if k in joints)
