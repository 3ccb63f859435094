"""The quantities of a trained model as CasADi expressions of q, qd and symbols of its residuals."""

from __future__ import annotations

from functools import cached_property

import casadi as ca
import numpy as np

from spelgen.exporting import friction_expressions
from spelgen.exporting.description import TrainedModel
from spelgen.exporting.entry_points import EntryPoint
from spelgen.exporting.residual_expressions import (
    coriolis,
    residual_symbols,
    symbol_slopes,
    symmetric,
)
from spelgen.exporting.rigid_expressions import (
    body_frames,
    constant,
    mass_and_potential,
    rigid_torque,
    tip_kinematics,
)

RESIDUAL = "residual_"
"""Stands before the names of residuals among a function's inputs."""


class ModelExpressions:
    """M(q) qdd + h(q, qd) + friction = G (tau - offset), in symbols q, qd, qdd, tau, u, z, dq of n or K n rows.

    Each entry point is a property of its name: an expression, or one for each output. derivatives: whether residuals
    come with their derivatives by q.
    """

    def __init__(self, model: TrainedModel, *, derivatives: bool = False) -> None:
        self.model = model
        self.n = model.n
        self._derivatives = derivatives
        names = ("q", "qd", "qdd", "tau", "dq", "u")
        self.inputs = {name: ca.SX.sym(name, self.n) for name in names}
        self.inputs["z"] = ca.SX.sym("z", model.memory)
        self.q, self.qd, self.qdd, self.tau, self.dq, self.u, self.z = self.inputs.values()
        self.residuals = residual_symbols(model)
        self._frames = body_frames(model.arm.bodies, self.q)
        self._rest = ca.SX(self.n, 1)

    def _rigid_torque(self, qd: ca.SX, qdd: ca.SX) -> ca.SX:
        return rigid_torque(self.model, self._frames, qd, qdd)

    @cached_property
    def _rigid_energies(self) -> tuple[ca.SX, ca.SX]:
        return mass_and_potential(self.model, self.q)

    @cached_property
    def _added_mass(self) -> ca.SX:
        """What drives and residuals add to M."""
        network = symmetric(self.model, self.residuals["mass"])
        return constant(self.model.constant_mass) + network

    @cached_property
    def mass_matrix(self) -> ca.SX:
        return self._rigid_energies[0] + self._added_mass

    @cached_property
    def _rigid_gravity(self) -> ca.SX:
        return self._rigid_torque(self._rest, self._rest)

    @cached_property
    def _residual_gravity(self) -> ca.SX:
        return self.residuals["gravity"] + self.residuals["torque"]

    @cached_property
    def gravity(self) -> ca.SX:
        return self._rigid_gravity + self._residual_gravity

    @cached_property
    def _residual_bias(self) -> ca.SX:
        if self.model.residuals.mass is None:
            return self._residual_gravity
        moved = coriolis(self.model, self.residuals, self.qd, derivatives=self._derivatives)
        return self._residual_gravity + moved

    @cached_property
    def bias(self) -> ca.SX:
        return self._rigid_torque(self.qd, self._rest) + self._residual_bias

    @cached_property
    def friction(self) -> ca.SX:
        """The torques of friction, which follows the speeds of the motors, (n, 1)."""
        law = self.model.friction
        motors = self.model.motors
        speed = constant(motors) @ self.qd
        load = self._rest
        # gravity would be computed for nothing
        if law.load_dependence.any():
            load = constant(np.linalg.inv(motors).T) @ self._rigid_gravity
        # a joint's dry friction follows velocity or bristles
        sliding = friction_expressions.turned(speed, law.coulomb_smoothing_velocity)
        direction = constant(law.memoryless) * sliding
        direction += friction_expressions.bristle_direction(law.bristle_fractions, self.model.reach, self.z)
        torque = friction_expressions.law_torque(law, speed, load, direction)
        for k, joint in enumerate(self.model.residuals.friction):
            torque[joint] *= ca.exp(self.residuals["factor"][k])
        return constant(motors.T) @ torque

    @property
    def friction_step(self) -> ca.SX:
        return friction_expressions.bristle_step(
            self.model.reach, self.z, constant(self.model.motors) @ self.dq
        )

    @property
    def friction_memory(self) -> ca.SX:
        width = self.model.friction.coulomb_smoothing_velocity
        speed = constant(self.model.motors) @ self.qd
        return friction_expressions.sliding_bristles(self.model.reach, width, speed)

    @cached_property
    def _force(self) -> ca.SX:
        """M qdd + h + friction, less what the drives add unseen, (n, 1)."""
        # one pass of Newton and Euler, where M qdd + h would take two
        rigid = self._rigid_torque(self.qd, self.qdd)
        added = self._added_mass @ self.qdd + self._residual_bias
        return rigid + added + self.friction - self._compensation

    @property
    def _compensation(self) -> ca.SX:
        return constant(np.diag(self.model.friction_compensation)) @ self.qd

    def _inputs(self, force: ca.SX) -> ca.SX:
        """Return the inputs that make these forces, (n, columns)."""
        # a passive joint's own torque is what it lacks
        inputs = self.model.inputs + np.diag(1 - self.model.actuated)
        if np.array_equal(inputs, np.eye(self.n)):
            return force
        return constant(np.linalg.inv(inputs)) @ force

    @property
    def inverse_dynamics(self) -> ca.SX:
        return self._inputs(self._force) + self.model.torque_offset

    @cached_property
    def forward_dynamics(self) -> ca.SX:
        force = constant(self.model.inputs) @ (self.tau - self.model.torque_offset)
        force = force + self._compensation - self.bias - self.friction
        return _solve(self.mass_matrix, force)

    @property
    def momentum(self) -> ca.SX:
        return self.mass_matrix @ self.qd

    @property
    def energy(self) -> ca.SX:
        potential = self._rigid_energies[1] + self.residuals["energy"] + self.residuals["torque_energy"]
        return ca.vertcat(0.5 * ca.dot(self.qd, self.momentum), potential)

    @property
    def tip_pose(self) -> ca.SX:
        return tip_kinematics(self.model, self.q)[0]

    @property
    def tip_jacobian(self) -> ca.SX:
        return tip_kinematics(self.model, self.q)[1]

    @property
    def servo_torque(self) -> ca.SX:
        servos = self.model.servos
        assert servos is not None
        error = self.u - self.q
        if servos.dead_zone.any():
            error = ca.fmax(error - servos.dead_zone, 0) - ca.fmax(-error - servos.dead_zone, 0)
        torque: ca.SX = servos.kp * error - servos.kd * self.qd
        for joint in np.flatnonzero(np.isfinite(servos.limit)).tolist():
            limit = servos.limit[joint]
            torque[joint] = ca.fmin(ca.fmax(torque[joint], -limit), limit)
        return torque

    def _force_derivatives(self) -> tuple[ca.SX, ca.SX]:
        """Return the derivatives of the force by q and by qd, (n, n) each."""
        symbols = [self.q]
        slopes = [ca.SX.eye(self.n)]
        # the chain rule through what the program computes by loops
        for symbol, slope in symbol_slopes(self.model, self.residuals):
            symbols.append(symbol)
            slopes.append(slope)
        by_position = ca.jtimes(self._force, ca.vertcat(*symbols), ca.vertcat(*slopes))
        return by_position, ca.jacobian(self._force, self.qd)

    @property
    def inverse_dynamics_derivatives(self) -> tuple[ca.SX, ca.SX]:
        by_position, by_velocity = self._force_derivatives()
        return self._inputs(by_position), self._inputs(by_velocity)

    @property
    def forward_dynamics_derivatives(self) -> tuple[ca.SX, ...]:
        """M^-1 times the derivatives of the force at this qdd (Carpentier and Mansard, RSS 2018)."""
        by_position, by_velocity = self._force_derivatives()
        right = ca.horzcat(-by_position, -by_velocity, constant(self.model.inputs))
        # the derivatives at the acceleration that the torques give
        right = ca.substitute(right, self.qdd, self.forward_dynamics)
        return tuple(ca.horzsplit(_solve(self.mass_matrix, right), self.n))


def expression_function(entry: EntryPoint, model: TrainedModel) -> ca.Function:
    """Return the entry point as a function of its inputs, then of the residuals that it needs; outputs are dense."""
    expressions = ModelExpressions(model, derivatives=entry.name.endswith("_derivatives"))
    result = getattr(expressions, entry.name)
    # most quantities have one output
    if not isinstance(result, tuple):
        result = (result,)
    outputs = [ca.densify(output) for output in result]
    inputs = {name: expressions.inputs[name] for name in entry.inputs}
    for name, symbols in expressions.residuals.items():
        if symbols.nnz() and ca.depends_on(ca.veccat(*outputs), symbols):
            inputs[RESIDUAL + name] = symbols
    names = list(inputs), list(entry.output_names)
    # what is computed twice becomes one step: by cse
    return ca.Function(entry.name, list(inputs.values()), outputs, *names, {"cse": True})


def residuals_needed(function: ca.Function) -> list[str]:
    """Return the names of the residuals that an ``expression_function`` takes."""
    return [name.removeprefix(RESIDUAL) for name in function.name_in() if name.startswith(RESIDUAL)]


def _solve(matrix: ca.SX, right: ca.SX) -> ca.SX:
    """Return matrix^-1 right by L D L^T, (n, columns); matrix is positive definite.

    Its lower triangle is never read, so that CasADi computes half of it. ``ca.ldl`` divides 21 times where this
    divides 6 times.
    """
    n = matrix.shape[0]
    # copies: they are changed
    matrix = ca.SX(matrix)
    right = ca.SX(right)
    factors: list[ca.SX] = []
    for k in range(n):
        inverse = 1 / matrix[k, k]
        row = matrix[k, k + 1 :]
        factor = inverse * row
        matrix[k + 1 :, k + 1 :] -= factor.T @ row
        right[k + 1 :, :] -= factor.T @ right[k, :]
        right[k, :] *= inverse
        factors.append(factor)
    for k in reversed(range(n)):
        right[k, :] -= factors[k] @ right[k + 1 :, :]
    return right
