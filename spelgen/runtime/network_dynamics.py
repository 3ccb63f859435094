"""A port-Hamiltonian model whose functions of q are networks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from spelgen.runtime.encoding import JointEncoding
from spelgen.runtime.parts import Friction, Inputs, Intermediates, Mass, Network, Parameters
from spelgen.runtime.port_hamiltonian import PortHamiltonian, applied
from spelgen.runtime.rows import Joint


class NetworkConfiguration(NamedTuple):
    """All that depends on q only."""

    encoded: Tensor  # input of the networks, see ``JointEncoding``
    mass: Tensor  # M(q), (..., n, n)
    intermediates: Intermediates  # of the derivatives of M
    parameters: dict[str, Parameters]


class NetworkDynamics(PortHamiltonian):
    """M, V and D are networks; the network of V is in units of ``potential_scale`` [J]."""

    def __init__(
        self,
        *,
        joints: Sequence[Joint],
        mass: Mass,
        potential: Network,
        potential_scale: float,
        friction: Friction,
        inputs: Inputs | None = None,
    ) -> None:
        super().__init__(joints, inputs)
        self.encoding, self.mass = JointEncoding(joints), mass
        self.potential, self.friction = potential, friction
        self.scale = nn.Buffer(torch.full((1, 1), potential_scale, dtype=torch.float64))

    def prepare(self) -> dict[str, Parameters]:
        """Return the parameter cache, by part."""
        potential = self.potential.prepare(self.scale, 0 * self.scale[0])
        return {"mass": self.mass.prepare(), "potential": potential, "friction": self.friction.prepare()}

    def configuration(self, q: Tensor, parameters: dict[str, Parameters]) -> NetworkConfiguration:
        """Return all that depends on q, (..., n), only."""
        encoded = self.encoding.forward(q)
        mass, intermediates = self.mass.forward(encoded, parameters["mass"])
        return NetworkConfiguration(encoded, mass, intermediates, parameters)

    def potential_energy(self, q: Tensor | NetworkConfiguration) -> Tensor:
        """Return V(q), (...) [J]."""
        cache: NetworkConfiguration = self.at(q)
        return self.potential.forward(cache.encoded, cache.parameters["potential"])[0].squeeze(-1)

    def gravity(self, q: Tensor | NetworkConfiguration) -> Tensor:
        """Return dV/dq, (..., n) [Nm, N]."""
        cache: NetworkConfiguration = self.at(q)
        return -self.lagrangian_gradient(cache, torch.zeros_like(cache.mass[..., 0]))

    def lagrangian_gradient(self, q: Tensor | NetworkConfiguration, qd: Tensor) -> Tensor:
        """Return d/dq of 1/2 qd^T M(q) qd - V(q), (..., n)."""
        cache: NetworkConfiguration = self.at(q, qd)
        intermediates = self.potential.forward(cache.encoded, cache.parameters["potential"])[1]
        kinetic = self.mass.kinetic_vjp(qd, cache.intermediates)
        return self.encoding.vjp(cache.encoded, kinetic - self.potential.vjp(intermediates, qd.new_ones(1)))

    def nonlinear_effects(self, q: Tensor | NetworkConfiguration, qd: Tensor) -> Tensor:
        """Return dM/dt qd - d/dq (1/2 qd^T M qd) + dV/dq, (..., n)."""
        cache: NetworkConfiguration = self.at(q, qd)
        mass_rate = self.mass.jvp(self.encoding.jvp(cache.encoded, qd), cache.intermediates)
        return applied(mass_rate, qd) - self.lagrangian_gradient(cache, qd)

    def friction_torque(self, q: Tensor | NetworkConfiguration, qd: Tensor) -> Tensor:
        """Return D(q, qd) qd, (..., n) [Nm, N]."""
        cache: NetworkConfiguration = self.at(q, qd)
        layers = cache.parameters["friction"]
        return self.friction.forward(cache.encoded, qd, layers, qd.unsqueeze(-1)).squeeze(-1)

    def dissipation(self, q: Tensor | NetworkConfiguration, qd: Tensor) -> Tensor:
        """Return D(q, qd), (..., n, n) [Nm s/rad, N s/m]."""
        cache: NetworkConfiguration = self.at(q, qd)
        return self.friction.forward(
            cache.encoded, qd, cache.parameters["friction"], torch.eye(self.n).to(qd)
        )

    def forward(self, t: Tensor, state: Tensor) -> Tensor:
        """Return the rate of (q, p), (..., 2 n), or of (q, p, tau) with a constant tau, (..., 3 n)."""
        q, p, tau = state.tensor_split((self.n, 2 * self.n), dim=-1)
        qd, force = self.port_hamiltonian_rhs(q, p, tau if tau.shape[-1] else None, self.prepare())
        return torch.cat([qd, force, torch.zeros_like(tau)], dim=-1)
