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

    ``at``, all that is computed of q alone, is q as networks read it (see ``JointEncoding``).
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
        self.encoding = encoding
        # Any: what a part has beside its protocol is there to be asked for
        self.mass: Any = mass
        self.friction: Any = friction
        self.input: Any = input
        self.potential = potential

    def prepare(self, definite: bool = True) -> NetworkPrepared:
        """All that depends on the weights alone; holds until they change."""
        return NetworkPrepared(
            mass=self.mass.prepare(definite),
            potential=None if self.potential is None else self.potential.prepare(),
            friction=self.friction.prepare(),
            input=self.input.prepare(),
        )

    def configuration(self, q: Tensor, prepared: NetworkPrepared) -> Tensor:
        """What networks read of q."""
        encoded: Tensor = self.encoding(q)
        return encoded

    def mass_at(self, at: Tensor, prepared: NetworkPrepared) -> tuple[Tensor, Any]:
        """M(q), (..., n, n), and what its derivatives need."""
        found: tuple[Tensor, Any] = self.mass(at, prepared.mass)
        return found

    def energy_at(self, at: Tensor, prepared: NetworkPrepared) -> Tensor:
        """V(q), (...) [J]."""
        if self.potential is None:
            return at.new_zeros(at.shape[:-1])
        energy: Tensor = self.potential(at, prepared.potential)
        return energy

    def gravity_at(self, at: Tensor, prepared: NetworkPrepared) -> Tensor:
        """dV/dq, (..., n) [Nm, N]."""
        if self.potential is None:
            return torch.zeros_like(at[..., : self.n])
        gradient: Tensor = self.encoding.vjp(at, self.potential.vjp(at, prepared.potential))
        return gradient

    def lagrangian_gradient(
        self, at: Tensor, qd: Tensor, residuals: Any, prepared: NetworkPrepared
    ) -> Tensor:
        """d/dq of 1/2 qd^T M(q) qd - V(q), (..., n)."""
        by_encoded = self.mass.kinetic_vjp(at, qd, residuals)
        if self.potential is not None:
            by_encoded = by_encoded - self.potential.vjp(at, prepared.potential)
        gradient: Tensor = self.encoding.vjp(at, by_encoded)
        return gradient

    def nonlinear_at(self, at: Tensor, qd: Tensor, residuals: Any, prepared: NetworkPrepared) -> Tensor:
        """dM/dt qd - d/dq (1/2 qd^T M qd) + dV/dq, (..., n)."""
        gradient = self.lagrangian_gradient(at, qd, residuals, prepared)
        mass_rate: Tensor = self.mass.jvp(self.encoding.jvp(at, qd), residuals)
        return applied(mass_rate, qd) - gradient

    def friction_at(
        self, at: Tensor, qd: Tensor, prepared: NetworkPrepared, z: Tensor | None = None
    ) -> Tensor:
        """D(q, qd) qd, (..., n) [Nm, N]; this friction has no memory."""
        torque: Tensor = self.friction(at, qd, prepared.friction)
        return torque

    def dissipation_at(self, at: Tensor, qd: Tensor, prepared: NetworkPrepared) -> Tensor:
        """D(q, qd), (..., n, n)."""
        matrix: Tensor = self.friction.dissipation(at, qd, prepared.friction)
        return matrix

    def input_at(self, at: Tensor, prepared: NetworkPrepared) -> Tensor:
        """G(q), (..., n, n)."""
        matrix: Tensor = self.input(at, prepared.input)
        return matrix

    def input_force(self, at: Tensor, qd: Tensor, tau: Tensor, prepared: NetworkPrepared) -> Tensor:
        """G tau, (..., n) [Nm, N]."""
        force: Tensor = self.input.force(at, tau, prepared.input)
        return force

    def input_torque(self, at: Tensor, qd: Tensor, force: Tensor, prepared: NetworkPrepared) -> Tensor:
        """The tau, (..., n), that makes this force."""
        tau: Tensor = self.input.solve(at, force, prepared.input)
        return tau
