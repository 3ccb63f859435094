"""A port-Hamiltonian model whose functions of q are networks and Fourier series."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from spelgen.runtime.configuration import Configuration
from spelgen.runtime.encoding import JointEncoding
from spelgen.runtime.fourier import FourierFeatures
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
    """The dynamics made of these parts; without a ``potential`` gravity does no work."""

    def __init__(
        self,
        encoding: JointEncoding,
        mass: Mass,
        potential: LearnedPotential | None,
        friction: Friction,
        input: Input,
        fourier: FourierFeatures | None = None,
    ) -> None:
        super().__init__()
        self.n, self.elements = len(encoding.center), 0
        self.encoding, self.fourier = encoding, fourier
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

    def configuration(self, q: Tensor, prepared: NetworkPrepared) -> Configuration:
        """What networks and Fourier series read of q."""
        encoded = self.encoding(q)
        if self.fourier is None:
            return Configuration(encoded, None)
        return Configuration(encoded, self.fourier(q, encoded[..., 2 * self.n :]))

    def mass_at(self, at: Configuration, prepared: NetworkPrepared) -> tuple[Tensor, Any]:
        """M(q), (..., n, n), and what its derivatives need."""
        found: tuple[Tensor, Any] = self.mass(at, prepared.mass)
        return found

    def energy_at(self, at: Configuration, prepared: NetworkPrepared) -> Tensor:
        """V(q), (...) [J]."""
        if self.potential is None:
            return at.encoded.new_zeros(at.encoded.shape[:-1])
        energy: Tensor = self.potential(at, prepared.potential)
        return energy

    def gravity_at(self, at: Configuration, prepared: NetworkPrepared) -> Tensor:
        """dV/dq, (..., n) [Nm, N]."""
        if self.potential is None:
            return torch.zeros_like(at.encoded[..., : self.n])
        by_network = self.potential.network_vjp(at, prepared.potential)
        gradient: Tensor = self.encoding.vjp(at.encoded, by_network)
        if at.fourier is None or prepared.potential.gradient is None:
            return gradient
        by_series: Tensor = at.fourier @ prepared.potential.gradient
        return gradient + by_series

    def lagrangian_gradient(
        self, at: Configuration, qd: Tensor, residuals: Any, prepared: NetworkPrepared
    ) -> Tensor:
        """d/dq of 1/2 qd^T M(q) qd - V(q), (..., n)."""
        by_encoded, by_fourier = self.mass.kinetic_vjp(at, qd, residuals)
        if self.potential is not None:
            by_encoded = by_encoded - self.potential.network_vjp(at, prepared.potential)
        gradient: Tensor = self.encoding.vjp(at.encoded, by_encoded)
        if self.fourier is None or at.fourier is None:
            return gradient
        if by_fourier is not None:
            gradient = gradient + self.fourier.vjp(at.fourier, by_fourier)
        if self.potential is not None and prepared.potential.gradient is not None:
            gradient = gradient - at.fourier @ prepared.potential.gradient
        return gradient

    def nonlinear_at(
        self, at: Configuration, qd: Tensor, residuals: Any, prepared: NetworkPrepared
    ) -> Tensor:
        """dM/dt qd - d/dq (1/2 qd^T M qd) + dV/dq, (..., n)."""
        gradient = self.lagrangian_gradient(at, qd, residuals, prepared)
        mass_rate: Tensor = self.mass.jvp(self._rate(at, qd), residuals)
        return applied(mass_rate, qd) - gradient

    def _rate(self, at: Configuration, qd: Tensor) -> Configuration:
        """How fast the configuration changes along qd."""
        by_fourier = None
        if self.fourier is not None and at.fourier is not None:
            by_fourier = self.fourier.jvp(at.fourier, qd)
        return Configuration(self.encoding.jvp(at.encoded, qd), by_fourier)

    def friction_at(
        self, at: Configuration, qd: Tensor, prepared: NetworkPrepared, z: Tensor | None = None
    ) -> Tensor:
        """D(q, qd) qd, (..., n) [Nm, N]; this friction has no memory."""
        torque: Tensor = self.friction(at.encoded, qd, prepared.friction)
        return torque

    def dissipation_at(self, at: Configuration, qd: Tensor, prepared: NetworkPrepared) -> Tensor:
        """D(q, qd), (..., n, n)."""
        matrix: Tensor = self.friction.dissipation(at.encoded, qd, prepared.friction)
        return matrix

    def input_at(self, at: Configuration, prepared: NetworkPrepared) -> Tensor:
        """G(q), (..., n, n)."""
        matrix: Tensor = self.input(at.encoded, prepared.input)
        return matrix

    def input_force(self, at: Configuration, qd: Tensor, tau: Tensor, prepared: NetworkPrepared) -> Tensor:
        """G tau, (..., n) [Nm, N]."""
        force: Tensor = self.input.force(at.encoded, tau, prepared.input)
        return force

    def input_torque(self, at: Configuration, qd: Tensor, force: Tensor, prepared: NetworkPrepared) -> Tensor:
        """The tau, (..., n), that makes this force."""
        tau: Tensor = self.input.solve(at.encoded, force, prepared.input)
        return tau
