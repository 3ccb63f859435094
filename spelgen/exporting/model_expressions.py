"""A trained model's quantities as CasADi expressions of q, qd, and what is given of its residuals."""

from __future__ import annotations

from functools import cached_property

import casadi as ca
import numpy as np

from spelgen.exporting import friction_expressions
from spelgen.exporting.description import TrainedModel
from spelgen.exporting.residual_expressions import (
    Level,
    ResidualSymbols,
    coriolis,
    entry_places,
    jets,
    placed,
)
from spelgen.exporting.rigid_expressions import RigidExpressions
from spelgen.exporting.solved_expressions import solved


class ModelExpressions:
    """M(q) qdd + h(q, qd) + friction = G (tau - offset), in symbols q, qd, qdd, tau, u, z, dq of n or ``memory`` rows.

    level: in which form ``residuals`` come in, see ``ResidualSymbols``.
    """

    def __init__(self, model: TrainedModel, level: Level = "rates") -> None:
        self.model, self.n, self.level = model, model.n, level
        self.q, self.qd, self.qdd, self.tau, self.dq, self.u = (
            ca.SX.sym(name, self.n) for name in ("q", "qd", "qdd", "tau", "dq", "u")
        )
        self.z = ca.SX.sym("z", model.memory)
        self.residuals = ResidualSymbols.of(model)
        self._places = entry_places(model)
        self._rigid = RigidExpressions(model, self.q)

    @property
    def servo_torque(self) -> ca.SX:
        """What position servos give under the delayed command u."""
        servos = self.model.servos
        assert servos is not None
        pull = self.u - self.q
        if servos.dead_zone.any():
            zone = ca.DM(servos.dead_zone)
            pull = ca.fmax(pull - zone, 0) - ca.fmax(-pull - zone, 0)
        torque = ca.DM(servos.kp) * pull - ca.DM(servos.kd) * self.qd
        rows = [
            ca.fmax(-ca.fmax(-torque[k], -limit), -limit) if np.isfinite(limit) else torque[k]
            for k, limit in enumerate(servos.limit.tolist())
        ]
        return ca.vertcat(*rows)

    @cached_property
    def _composite(self) -> tuple[ca.SX, ca.SX]:
        return self._rigid.mass_and_moment()

    @cached_property
    def _added_mass(self) -> ca.SX:
        """What drives and residuals add to M."""
        return _sparse(self.model.constant_mass) + placed(self.n, self._places, self.residuals.mass)

    @cached_property
    def mass_matrix(self) -> ca.SX:
        """M, (n, n)."""
        return self._composite[0] + self._added_mass

    @cached_property
    def _rigid_gravity(self) -> ca.SX:
        return self._rigid.torque(None, None)

    @cached_property
    def _residual_gravity(self) -> ca.SX:
        found = ca.SX(self.n, 1)
        for each in (self.residuals.gravity, self.residuals.torque):
            found = found + each if each.numel() else found
        return found

    @cached_property
    def gravity(self) -> ca.SX:
        """dV/dq, (n, 1)."""
        return self._rigid_gravity + self._residual_gravity

    @cached_property
    def _residual_bias(self) -> ca.SX:
        if not self._places:
            return self._residual_gravity
        return self._residual_gravity + coriolis(self.residuals, self._places, self.level, self.qd)

    @cached_property
    def bias(self) -> ca.SX:
        """Coriolis, centrifugal and gravity torque, (n, 1)."""
        return self._rigid.torque(self.qd, None) + self._residual_bias

    @cached_property
    def friction(self) -> ca.SX:
        """What friction takes, its memory included, (n, 1)."""
        law, bristles, gravity = self.model.friction, self.model.bristles, ca.SX(self.n, 1)
        speed, back = self._driven(self.qd), _sparse(self.model.motors.T)
        if law.load_dependence.any():
            gravity = _sparse(np.linalg.inv(self.model.motors).T) @ self._rigid_gravity
        direction = (
            friction_expressions.sliding_direction(law, speed)
            if bristles is None
            else friction_expressions.bristle_direction(bristles, self.z)
        )
        torque = friction_expressions.law_torque(law, speed, gravity, direction)
        for k, joint in enumerate(self.model.residuals.friction.joints):
            torque[joint] *= ca.exp(self.residuals.factor[k])
        return back @ torque

    def _driven(self, joints: ca.SX) -> ca.SX:
        """Velocities or displacements of the drives, (n, 1), by the joints'."""
        return _sparse(self.model.motors) @ joints

    @cached_property
    def friction_step(self) -> ca.SX:
        """Friction's memory after each joint went one way by dq, (memory, 1)."""
        if self.model.bristles is None:
            return self.z
        return friction_expressions.bristle_step(self.model.bristles, self.z, self._driven(self.dq))

    @cached_property
    def friction_memory(self) -> ca.SX:
        """Friction's memory of joints that have long gone the way of qd, (memory, 1)."""
        if self.model.bristles is None:
            return self.z
        speed = self._driven(self.qd)
        return friction_expressions.sliding_bristles(self.model.bristles, self.model.friction, speed)

    @cached_property
    def force(self) -> ca.SX:
        """What the inputs do: M qdd + h + friction, less what the drives add unseen, (n, 1)."""
        moved = self._rigid.torque(self.qd, self.qdd) + self._added_mass @ self.qdd
        return moved + self._residual_bias + self.friction - self._compensation

    @cached_property
    def inverse_dynamics(self) -> ca.SX:
        """tau, (n, 1)."""
        return self._inputs(self.force) + self.model.torque_offset

    @cached_property
    def _compensation(self) -> ca.SX:
        """What the drives add unseen, (n, 1)."""
        return _sparse(np.diag(self.model.friction_compensation)) @ self.qd

    def _inputs(self, force: ca.SX) -> ca.SX:
        """The inputs that make these forces; (n, columns)."""
        moved = self.model.inputs + np.diag(1 - self.model.actuated)
        return force if np.array_equal(moved, np.eye(self.n)) else _sparse(np.linalg.inv(moved)) @ force

    @cached_property
    def forward_dynamics(self) -> ca.SX:
        """qdd, (n, 1)."""
        force = _sparse(self.model.inputs) @ (self.tau - self.model.torque_offset)
        return solved(self.mass_matrix, force + self._compensation - self.bias - self.friction)

    @cached_property
    def momentum(self) -> ca.SX:
        """M qd, (n, 1)."""
        return self.mass_matrix @ self.qd

    @cached_property
    def energy(self) -> ca.SX:
        """Kinetic and potential, (2, 1) [J]."""
        potential = -ca.dot(self.model.gravity, self._composite[1])
        for each in (self.residuals.energy, self.residuals.torque_energy):
            potential = potential + each if each.numel() else potential
        return ca.vertcat(0.5 * ca.dot(self.qd, self.momentum), potential)

    def force_derivatives(self) -> tuple[ca.SX, ca.SX]:
        """How ``force`` changes with q and with qd, (n, n) each; residuals come as jets."""
        reads = [(self.q, ca.SX.eye(self.n)), *jets(self.model, self.residuals)]
        symbols, slopes = (ca.vertcat(*column) for column in zip(*reads, strict=True))
        return ca.jtimes(self.force, symbols, slopes), ca.jacobian(self.force, self.qd)

    def inverse_dynamics_derivatives(self) -> tuple[ca.SX, ca.SX]:
        """dtau/dq and dtau/dqd, (n, n) each; dtau/dqdd is M where each torque is its own joint's."""
        by_position, by_velocity = self.force_derivatives()
        return self._inputs(by_position), self._inputs(by_velocity)

    def forward_dynamics_derivatives(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """dqdd/dq, dqdd/dqd and dqdd/dtau, (n, n) each: M^-1 times what the force changes by at this qdd."""
        by_position, by_velocity = self.force_derivatives()
        right = ca.horzcat(-by_position, -by_velocity, _sparse(self.model.inputs))
        moving = ca.substitute(right, self.qdd, self.forward_dynamics)
        found = solved(self.mass_matrix, moving)
        return found[:, : self.n], found[:, self.n : 2 * self.n], found[:, 2 * self.n :]


def _sparse(matrix: np.ndarray) -> ca.DM:
    return ca.sparsify(ca.DM(matrix))
