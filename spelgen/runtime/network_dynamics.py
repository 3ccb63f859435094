"""A port-Hamiltonian model whose functions of q are networks."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from spelgen.runtime.encoding import JointEncoding
from spelgen.runtime.parts import Friction, Input, Mass
from spelgen.runtime.port_hamiltonian import PortHamiltonian, applied
from spelgen.runtime.potential import LearnedPotential


class NetworkPrepared(NamedTuple):
    """What depends on the weights alone, by part."""

    mass: Any
    potential: Any
    friction: Any
    input: Any


class NetworkDynamics(PortHamiltonian):
    """The dynamics made of these parts; without a ``potential`` gravity does no work.

    ``pose``, all that is computed of q alone, is q as networks read it (see ``JointEncoding``).
    """

    def __init__(
        self,
        encoding: JointEncoding,
        mass: Mass,
        potential: LearnedPotential | None,
        friction: Friction,
        input: Input,
    ) -> None:
        super().__init__()
        self.encoding, self.mass, self.potential = encoding, mass, potential
        self.friction, self.input = friction, input

    def prepare(self, definite: bool = True) -> NetworkPrepared:
        """Return all that depends on the weights alone; M is kept ``definite``, or is as learned."""
        potential = None if self.potential is None else self.potential.prepare()
        mass = self.mass.prepare(definite)
        return NetworkPrepared(mass, potential, self.friction.prepare(), self.input.prepare())

    def configuration(self, q: Tensor, prepared: NetworkPrepared) -> Tensor:
        """Return what networks read of q."""
        return self.encoding.forward(q)

    def mass_at(self, pose: Tensor, prepared: NetworkPrepared) -> tuple[Tensor, Any]:
        """Return M(q), (..., n, n), and what its derivatives need."""
        return self.mass.forward(pose, prepared.mass)

    def energy_at(self, pose: Tensor, prepared: NetworkPrepared) -> Tensor:
        """Return V(q), (...) [J]."""
        if self.potential is None:
            return pose.new_zeros(pose.shape[:-1])
        return self.potential.forward(pose, prepared.potential)

    def gravity_at(self, pose: Tensor, prepared: NetworkPrepared) -> Tensor:
        """Return dV/dq, (..., n) [Nm, N]."""
        if self.potential is None:
            return torch.zeros_like(pose[..., : self.n])
        return self.encoding.vjp(pose, self.potential.vjp(pose, prepared.potential))

    def lagrangian_gradient(
        self, pose: Tensor, qd: Tensor, residuals: Any, prepared: NetworkPrepared
    ) -> Tensor:
        """Return d/dq of 1/2 qd^T M(q) qd - V(q), (..., n)."""
        by_encoded = self.mass.kinetic_vjp(pose, qd, residuals)
        if self.potential is not None:
            by_encoded = by_encoded - self.potential.vjp(pose, prepared.potential)
        return self.encoding.vjp(pose, by_encoded)

    def nonlinear_at(self, pose: Tensor, qd: Tensor, residuals: Any, prepared: NetworkPrepared) -> Tensor:
        """Return dM/dt qd - d/dq (1/2 qd^T M qd) + dV/dq, (..., n)."""
        mass_rate = self.mass.jvp(self.encoding.jvp(pose, qd), residuals)
        return applied(mass_rate, qd) - self.lagrangian_gradient(pose, qd, residuals, prepared)

    def friction_at(self, pose: Tensor, qd: Tensor, prepared: NetworkPrepared) -> Tensor:
        """Return D(q, qd) qd, (..., n) [Nm, N]."""
        return self.friction.forward(pose, qd, prepared.friction)

    def dissipation_at(self, pose: Tensor, qd: Tensor, prepared: NetworkPrepared) -> Tensor:
        """Return D(q, qd), (..., n, n)."""
        return self.friction.dissipation(pose, qd, prepared.friction)

    def input_at(self, pose: Tensor, prepared: NetworkPrepared) -> Tensor:
        """Return G(q), (..., n, n)."""
        return self.input.forward(pose, prepared.input)

    def input_force(self, pose: Tensor, qd: Tensor, tau: Tensor, prepared: NetworkPrepared) -> Tensor:
        """Return G tau, (..., n) [Nm, N]."""
        return self.input.force(pose, tau, prepared.input)

    def input_torque(self, pose: Tensor, qd: Tensor, force: Tensor, prepared: NetworkPrepared) -> Tensor:
        """Return the tau, (..., n), that makes this force."""
        return self.input.solve(pose, force, prepared.input)
