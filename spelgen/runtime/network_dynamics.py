"""A port-Hamiltonian model whose functions of q are networks."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from spelgen.runtime.encoding import JointEncoding
from spelgen.runtime.joints import Joints
from spelgen.runtime.parts import (
    Friction,
    FrictionPrepared,
    Mass,
    MassPrepared,
    MassResiduals,
    Network,
)
from spelgen.runtime.port_hamiltonian import PortHamiltonian, applied


class NetworkPrepared(NamedTuple):
    """What depends on the weights alone, by part."""

    mass: MassPrepared
    potential: Any  # a network's layers, or None
    friction: FrictionPrepared
    input: Any = None


class NetworkDynamics(PortHamiltonian):
    """M and D of these parts; V is a network's, in units of ``scale`` [J]; without one gravity does no work.

    ``pose``, all that is computed of q alone, is q as networks read it (see ``JointEncoding``).
    """

    def __init__(
        self, joints: Joints, mass: Mass, potential: Network | None, scale: float, friction: Friction
    ) -> None:
        super().__init__(joints)
        self.encoding, self.mass = JointEncoding(joints), mass
        self.potential, self.friction = potential, friction
        self.scale = nn.Buffer(torch.full((1, 1), scale, dtype=torch.float64))

    def prepare(self, definite: bool = True) -> NetworkPrepared:
        """Return all that depends on the weights alone; M is kept ``definite``, or is as learned."""
        potential = None if self.potential is None else self.potential.prepare(self.scale, 0 * self.scale[0])
        return NetworkPrepared(self.mass.prepare(definite), potential, self.friction.prepare())

    def configuration(self, q: Tensor, prepared: NetworkPrepared) -> Tensor:
        """Return what networks read of q."""
        return self.encoding.forward(q)

    def mass_at(self, pose: Tensor, prepared: NetworkPrepared) -> tuple[Tensor, MassResiduals]:
        """Return M(q), (..., n, n), and what its derivatives need."""
        return self.mass.forward(pose, prepared.mass)

    def energy_at(self, pose: Tensor, prepared: NetworkPrepared) -> Tensor:
        """Return V(q), (...) [J]."""
        if self.potential is None:
            return pose.new_zeros(pose.shape[:-1])
        return self.potential.forward(pose, prepared.potential)[0].squeeze(-1)

    def gravity_at(self, pose: Tensor, prepared: NetworkPrepared) -> Tensor:
        """Return dV/dq, (..., n) [Nm, N]."""
        return -self._downhill(pose, torch.zeros_like(pose), prepared)

    def _downhill(self, pose: Tensor, kinetic: Tensor, prepared: NetworkPrepared) -> Tensor:
        """The derivative by q of what has the derivative ``kinetic`` by the encoding, less dV/dq."""
        if self.potential is not None:
            residuals = self.potential.forward(pose, prepared.potential)[1]
            kinetic = kinetic - self.potential.vjp(residuals, pose.new_ones(1))
        return self.encoding.vjp(pose, kinetic)

    def lagrangian_gradient(
        self, pose: Tensor, qd: Tensor, residuals: MassResiduals, prepared: NetworkPrepared
    ) -> Tensor:
        """Return d/dq of 1/2 qd^T M(q) qd - V(q), (..., n)."""
        return self._downhill(pose, self.mass.kinetic_vjp(pose, qd, residuals), prepared)

    def nonlinear_at(
        self, pose: Tensor, qd: Tensor, residuals: MassResiduals, prepared: NetworkPrepared
    ) -> Tensor:
        """Return dM/dt qd - d/dq (1/2 qd^T M qd) + dV/dq, (..., n)."""
        mass_rate = self.mass.jvp(self.encoding.jvp(pose, qd), residuals)
        return applied(mass_rate, qd) - self.lagrangian_gradient(pose, qd, residuals, prepared)

    def friction_at(self, pose: Tensor, qd: Tensor, prepared: NetworkPrepared) -> Tensor:
        """Return D(q, qd) qd, (..., n) [Nm, N]."""
        return self.friction.forward(pose, qd, prepared.friction)

    def dissipation_at(self, pose: Tensor, qd: Tensor, prepared: NetworkPrepared) -> Tensor:
        """Return D(q, qd), (..., n, n)."""
        return self.friction.dissipation(pose, qd, prepared.friction)
