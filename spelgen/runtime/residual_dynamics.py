"""Rigid bodies, and what logs show beside them: functions of single joints, and networks."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from spelgen.runtime.encoding import JointEncoding
from spelgen.runtime.joint_functions import JointFunctions, JointFunctionWeights
from spelgen.runtime.joints import Joints, Rows
from spelgen.runtime.parts import MassResiduals, Network
from spelgen.runtime.port_hamiltonian import applied
from spelgen.runtime.residual_mass import ResidualMass, ResidualMassPrepared
from spelgen.runtime.rigid_body import Bodies, Row
from spelgen.runtime.rigid_body_dynamics import Motion, RigidBodyDynamics, RigidPrepared


class ResidualPrepared(NamedTuple):
    """What depends on the weights alone."""

    mass: ResidualMassPrepared
    potential: Any  # a network's layers, or None
    functions: JointFunctionWeights


class ResidualMotion(NamedTuple):
    """What residuals read of a position."""

    q: Tensor
    encoded: Tensor
    torque: Tensor  # of the joints' own functions, (..., n) [Nm, N]
    factor: Tensor  # on friction, (..., n)


class ResidualDynamics(RigidBodyDynamics):
    """Rigid bodies with residuals in M, V and friction; with their weights zero they are bodies alone.

    M = that of bodies and drives + R(q), positive definite for all weights (see ``ResidualMass``).
    V = that of bodies + a network's, in units of ``scale`` [J], + each joint's own. Friction is multiplied
    by a positive factor. Where ``residual_mass`` is None, what has no residuals is not computed.
    """

    residual_mass: ResidualMass | None

    def __init__(
        self,
        joints: Joints,
        bodies: Bodies,
        gravity: Row,
        reach: Rows,
        motors: Rows,
        mass: ResidualMass,
        potential: Network | None,
        scale: float,
    ) -> None:
        super().__init__(joints, bodies, gravity, reach, motors)
        self.encoding, self.joint_functions = JointEncoding(joints), JointFunctions(joints)
        self.residual_mass, self.residual_potential = mass, potential
        self.scale = nn.Buffer(torch.full((1, 1), scale, dtype=torch.float64))

    def prepare(self, definite: bool = True) -> RigidPrepared:
        """Return all that depends on the weights alone; holds until they change."""
        prepared, potential, scale = super().prepare(definite), self.residual_potential, self.scale
        if self.residual_mass is None:
            return prepared
        layers = None if potential is None else potential.prepare(scale, 0 * scale[0])
        mass = self.residual_mass.prepare(prepared.armature)
        return prepared._replace(residual=ResidualPrepared(mass, layers, self.joint_functions.prepare()))

    def configuration(self, q: Tensor, prepared: RigidPrepared) -> Motion:
        """Return how the bodies may move at q, and what residuals read of q."""
        pose = super().configuration(q, prepared)
        return pose if self.residual_mass is None else pose._replace(residual=self._read(q, prepared))

    def _read(self, q: Tensor, prepared: RigidPrepared) -> ResidualMotion:
        functions = self.joint_functions.forward(q, prepared.residual.functions)
        return ResidualMotion(q, self.encoding.forward(q), *functions)

    def mass_at(self, pose: Motion, prepared: RigidPrepared) -> tuple[Tensor, MassResiduals]:
        """Return M(q), (..., n, n), and what its derivatives need."""
        mass = super().mass_at(pose, prepared)[0]
        if self.residual_mass is None:
            return mass, None
        residual, residuals = self.residual_mass.forward(pose.residual.encoded, prepared.residual.mass)
        return mass + residual, residuals

    def energy_at(self, pose: Motion, prepared: RigidPrepared) -> Tensor:
        """Return V(q), (...) [J]."""
        energy = super().energy_at(pose, prepared)
        if self.residual_mass is None:
            return energy
        energy = energy + self.joint_functions.energy(pose.residual.q)
        if self.residual_potential is None:
            return energy
        residual = self.residual_potential.forward(pose.residual.encoded, prepared.residual.potential)[0]
        return energy + residual.squeeze(-1)

    def gravity_at(self, pose: Motion, prepared: RigidPrepared) -> Tensor:
        """Return dV/dq, (..., n) [Nm, N]."""
        if self.residual_mass is None:
            return pose.gravity
        kinetic = torch.zeros_like(pose.residual.encoded)
        return pose.gravity - self._gradient(pose.residual, kinetic, prepared)

    def lagrangian_gradient(
        self, pose: Motion, qd: Tensor, residuals: MassResiduals, prepared: RigidPrepared
    ) -> Tensor:
        """Return d/dq of 1/2 qd^T M(q) qd - V(q), (..., n)."""
        gradient = super().lagrangian_gradient(pose, qd, None, prepared)
        if self.residual_mass is None:
            return gradient
        kinetic = self.residual_mass.kinetic_vjp(pose.residual.encoded, qd, residuals)
        return gradient + self._gradient(pose.residual, kinetic, prepared)

    def nonlinear_at(
        self, pose: Motion, qd: Tensor, residuals: MassResiduals, prepared: RigidPrepared
    ) -> Tensor:
        """Return the torque that holds qd steady without friction, (..., n)."""
        torque = super().nonlinear_at(pose, qd, None, prepared)
        if self.residual_mass is None:
            return torque
        return torque + self._nonlinear(pose.residual, qd, residuals, prepared)

    def residual_torque(self, q: Tensor, qd: Tensor, qdd: Tensor, prepared: RigidPrepared) -> Tensor:
        """Return what the residuals of M and V take, (..., n) [Nm, N]."""
        if self.residual_mass is None:
            return torch.zeros_like(q)
        read = self._read(q, prepared)
        mass, residuals = self.residual_mass.forward(read.encoded, prepared.residual.mass)
        return applied(mass, qdd) + self._nonlinear(read, qd, residuals, prepared)

    def _varied(self, friction: Tensor, pose: Motion) -> Tensor:
        """The laws' friction of the drives as it is at this position, (..., n)."""
        return friction if self.residual_mass is None else pose.residual.factor * friction

    def _nonlinear(
        self, read: ResidualMotion, qd: Tensor, residuals: MassResiduals, prepared: RigidPrepared
    ) -> Tensor:
        """dR/dt qd - d/dq of what the residuals add to 1/2 qd^T M(q) qd - V(q), (..., n)."""
        rate = self.encoding.jvp(read.encoded, qd)
        assert self.residual_mass is not None
        moved, kinetic = self.residual_mass.coriolis(rate, qd, residuals)
        return moved - self._gradient(read, kinetic, prepared)

    def _gradient(self, read: ResidualMotion, kinetic: Tensor, prepared: RigidPrepared) -> Tensor:
        """d/dq of what the residuals add to 1/2 qd^T M(q) qd - V(q), (..., n); kinetic: by the encoding."""
        if self.residual_potential is not None:
            residuals = self.residual_potential.forward(read.encoded, prepared.residual.potential)[1]
            kinetic = kinetic - self.residual_potential.vjp(residuals, read.encoded.new_ones(1))
        return self.encoding.vjp(read.encoded, kinetic) - read.torque
