"""A trained model's quantities as CasADi expressions of q, qd, and what its networks give."""

from __future__ import annotations

from functools import cached_property

import casadi as ca
import numpy as np

from spelgen.exporting import friction_expressions, learned_expressions
from spelgen.exporting.description import FrictionLaw, TrainedModel
from spelgen.exporting.learned_expressions import (
    Level,
    NetworkSymbols,
    entry_places,
    has_potential_network,
    placed,
    solved,
)
from spelgen.exporting.rigid_expressions import RigidExpressions


class ModelExpressions:
    """M(q) qdd + h(q, qd) + friction = G (tau - offset), in symbols q, qd, qdd, tau, u, z, dq of n or ``memory`` rows.

    level: in which form ``networks`` come in, see ``NetworkSymbols``.
    """

    def __init__(self, model: TrainedModel, level: Level = "rates") -> None:
        self.model, self.n, self.level = model, model.n, level
        self.q, self.qd, self.qdd, self.tau, self.dq, self.u = (
            ca.SX.sym(name, self.n) for name in ("q", "qd", "qdd", "tau", "dq", "u")
        )
        self.z = ca.SX.sym("z", model.memory)
        self.places = entry_places(model)
        self.networks = NetworkSymbols.of(self.n, len(self.places), has_potential_network(model))

    @property
    def servo_torque(self) -> ca.SX:
        """What position servos give under the delayed command u."""
        servos = self.model.servos
        assert servos is not None
        torque = ca.DM(servos.kp) * (self.u - self.q) - ca.DM(servos.kd) * self.qd
        rows = [
            ca.fmax(-ca.fmax(-torque[k], -limit), -limit) if np.isfinite(limit) else torque[k]
            for k, limit in enumerate(servos.limit.tolist())
        ]
        return ca.vertcat(*rows)

    @cached_property
    def _rigid(self) -> RigidExpressions | None:
        return None if self.model.inertias is None else RigidExpressions(self.model, self.q)

    @cached_property
    def _composite(self) -> tuple[ca.SX, ca.SX]:
        assert self._rigid is not None
        return self._rigid.mass_and_moment()

    @cached_property
    def _known_mass(self) -> ca.SX:
        """What of M needs no network."""
        mass = ca.SX(_sparse(self.model.rotors))
        if self._rigid is not None:
            mass = mass + self._composite[0]
        if self.model.learned is not None:
            rows = learned_expressions.known_part(self.model.learned, self.model.learned.mass, self.q)
            mass = mass + ca.reshape(rows, self.n, self.n)
        return mass

    @cached_property
    def _known_energy(self) -> ca.SX:
        """What of V needs no network; zero for a mass at the base's origin."""
        energy = ca.SX(1, 1)
        if self._rigid is not None:
            energy = energy - ca.dot(self.model.gravity, self._composite[1])
        learned = self.model.learned
        if learned is not None and learned.potential is not None:
            energy = energy + learned_expressions.known_part(learned, learned.potential, self.q)
        return energy

    @cached_property
    def _unbounded(self) -> ca.SX:
        return self._known_mass + placed(self.n, self.places, self.networks.mass)

    @cached_property
    def _part(self) -> ca.SX:
        """t of the bound that keeps M positive definite: one where nothing need be drawn."""
        learned = self.model.learned
        if learned is None or learned.bound is None:
            return ca.SX(1)
        return learned_expressions.bound_part(learned.bound, self._unbounded)

    @cached_property
    def mass_matrix(self) -> ca.SX:
        """M, (n, n)."""
        learned = self.model.learned
        if learned is None or learned.bound is None:
            return self._unbounded
        center = ca.SX(_sparse(learned.bound.center))
        return center + self._part * (self._unbounded - center)

    @cached_property
    def gravity(self) -> ca.SX:
        """dV/dq, (n, 1)."""
        found = ca.SX(self.n, 1)
        if self._rigid is not None:
            found = found + self._rigid.torque(None, None)
        if self.model.learned is not None:
            if self.model.learned.potential is not None:
                found = found + ca.gradient(self._learned_energy, self.q)
            if self.networks.gravity.numel():
                found = found + self.networks.gravity
        return found

    @cached_property
    def _learned_energy(self) -> ca.SX:
        learned = self.model.learned
        assert learned is not None
        assert learned.potential is not None
        return learned_expressions.known_part(learned, learned.potential, self.q)

    @cached_property
    def bias(self) -> ca.SX:
        """Coriolis, centrifugal and gravity torque, (n, 1)."""
        if self.model.learned is None:
            assert self._rigid is not None
            return self._rigid.torque(self.qd, None)
        found = ca.SX(self.n, 1)
        if self._rigid is not None:
            found = found + self._rigid.torque(self.qd, None, gravity=False)
        return self._part * (found + self._learned_coriolis()) + self.gravity

    def _learned_coriolis(self) -> ca.SX:
        """dM/dt qd - d/dq (1/2 qd^T M qd) of Fourier series and networks."""
        learned, qd, given = self.model.learned, self.qd, self.networks
        assert learned is not None
        rows = learned_expressions.known_part(learned, learned.mass, self.q)
        known = ca.reshape(rows, self.n, self.n)
        rate = ca.reshape(ca.jtimes(known, self.q, qd), self.n, self.n)
        kinetic = ca.gradient(0.5 * ca.dot(qd, known @ qd), self.q)
        if self.places and self.level == "jets":
            rate = rate + placed(self.n, self.places, given.first @ qd)
            each = [placed(self.n, self.places, given.first[:, i]) for i in range(self.n)]
            kinetic = kinetic + ca.vertcat(*(0.5 * ca.dot(qd, by_joint @ qd) for by_joint in each))
        elif self.places:
            rate = rate + placed(self.n, self.places, given.rate)
            kinetic = kinetic + given.kinetic
        return rate @ qd - kinetic

    @cached_property
    def friction(self) -> ca.SX:
        """What friction takes, its memory included, (n, 1)."""
        law = self.model.friction
        if isinstance(law, FrictionLaw):
            speed, back = self._driven(self.qd), _sparse(self.model.motors.T)
            gravity = ca.SX(self.n, 1)
            if law.load_dependence.any():
                gravity = _sparse(np.linalg.inv(self.model.motors).T) @ self.gravity
            bristles = self.model.bristles
            direction = (
                friction_expressions.sliding_direction(law, speed)
                if bristles is None
                else friction_expressions.bristle_direction(bristles, self.z)
            )
            found = back @ friction_expressions.law_torque(law, speed, gravity, direction)
        else:
            assert self.model.learned is not None
            read = learned_expressions.encoded(self.model.learned.encoding, self.q)
            found = friction_expressions.network_torque(law, read, self.qd)
        return found

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
        law, bristles = self.model.friction, self.model.bristles
        if bristles is None or not isinstance(law, FrictionLaw):
            return self.z
        return friction_expressions.sliding_bristles(bristles, law, self._driven(self.qd))

    @cached_property
    def force(self) -> ca.SX:
        """What the inputs do: M qdd + h + friction, less what the drives add unseen, (n, 1)."""
        if self.model.learned is None:
            assert self._rigid is not None
            moved = self._rigid.torque(self.qd, self.qdd) + _sparse(self.model.rotors) @ self.qdd
        else:
            moved = self.mass_matrix @ self.qdd + self.bias
        return moved + self.friction - self._compensation

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
        potential = self._known_energy
        if self.networks.energy.numel():
            potential = potential + self.networks.energy
        return ca.vertcat(0.5 * ca.dot(self.qd, self.momentum), potential)

    def force_derivatives(self) -> tuple[ca.SX, ca.SX]:
        """How ``force`` changes with q and with qd, (n, n) each; networks come as jets."""
        by_velocity = ca.jacobian(self.force, self.qd)
        reads, given, n = [self.q], self.networks, self.n
        seeds = [ca.SX.eye(n)]
        if self.places:
            reads += [given.mass, ca.vec(given.first)]
            seeds += [given.first, ca.vertcat(*(self._second(given.second, j) for j in range(n)))]
        if given.gravity.numel():
            reads.append(given.gravity)
            seeds.append(self._second(given.stiffness.T, slice(None)))
        return ca.jtimes(self.force, ca.vertcat(*reads), ca.vertcat(*seeds)), by_velocity

    def _second(self, pairs: ca.SX, row: int | slice) -> ca.SX:
        """Second derivatives of k functions, (k, n (n + 1) / 2), as those by a joint and each other: (k, n).

        Of one function and all joints: its symmetric matrix, (n, n).
        """
        place = {pair: k for k, pair in enumerate(upper_pairs(self.n))}
        columns = lambda j: [place[min(i, j), max(i, j)] for i in range(self.n)]  # noqa: E731
        if isinstance(row, int):
            return pairs[:, columns(row)]
        return ca.vertcat(*(pairs[0, columns(j)] for j in range(self.n)))

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


def upper_pairs(n: int) -> list[tuple[int, int]]:
    """Row and column of an upper triangle, row by row."""
    return [(i, j) for i in range(n) for j in range(i, n)]


def _sparse(matrix: np.ndarray) -> ca.DM:
    return ca.sparsify(ca.DM(matrix))
