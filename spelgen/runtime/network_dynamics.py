"""A port-Hamiltonian model whose functions of q are networks."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from spelgen.runtime.encoding import JointEncoding
from spelgen.runtime.joints import Joints
from spelgen.runtime.parts import Friction, Intermediates, Mass, Network, Prepared
from spelgen.runtime.port_hamiltonian import PortHamiltonian, applied


class NetworkPose(NamedTuple):
    """What depends on q alone."""

    encoded: Tensor  # q as networks read it, see ``JointEncoding``
    mass: Tensor  # M(q), (..., n, n)
    intermediates: Intermediates  # what M's derivatives need
    prepared: Prepared


class NetworkDynamics(PortHamiltonian):
    """M and D of these parts; V is a network's, in units of ``scale`` [J]."""

    def __init__(self, joints: Joints, mass: Mass, energy: Network, scale: float, friction: Friction) -> None:
        super().__init__()
        self.encoding, self.mass = JointEncoding(joints), mass
        self.potential, self.friction = energy, friction
        self.scale = nn.Buffer(torch.full((1, 1), scale, dtype=torch.float64))

    def prepare(self) -> Prepared:
        """Return all that depends on the weights alone, by part."""
        potential = self.potential.prepare(self.scale, 0 * self.scale[0])
        return {"mass": self.mass.prepare(), "potential": potential, "friction": self.friction.prepare()}

    def configuration(self, q: Tensor, prepared: Prepared) -> NetworkPose:
        """Return what depends on q alone."""
        encoded = self.encoding.forward(q)
        mass, intermediates = self.mass.forward(encoded, prepared["mass"])
        return NetworkPose(encoded, mass, intermediates, prepared)

    def potential_energy(self, q: Tensor | NetworkPose) -> Tensor:
        """Return V(q), (...) [J]."""
        pose: NetworkPose = self.at(q)
        return self.potential.forward(pose.encoded, pose.prepared["potential"])[0].squeeze(-1)

    def gravity(self, q: Tensor | NetworkPose) -> Tensor:
        """Return dV/dq, (..., n) [Nm, N]."""
        pose: NetworkPose = self.at(q)
        return -self.lagrangian_gradient(pose, torch.zeros_like(pose.mass[..., 0]))

    def lagrangian_gradient(self, q: Tensor | NetworkPose, qd: Tensor) -> Tensor:
        """Return d/dq of 1/2 qd^T M(q) qd - V(q), (..., n)."""
        pose: NetworkPose = self.at(q, qd)
        intermediates = self.potential.forward(pose.encoded, pose.prepared["potential"])[1]
        kinetic = self.mass.kinetic_vjp(qd, pose.intermediates)
        return self.encoding.vjp(pose.encoded, kinetic - self.potential.vjp(intermediates, qd.new_ones(1)))

    def nonlinear_effects(self, q: Tensor | NetworkPose, qd: Tensor) -> Tensor:
        """Return dM/dt qd - d/dq (1/2 qd^T M qd) + dV/dq, (..., n)."""
        pose: NetworkPose = self.at(q, qd)
        mass_rate = self.mass.jvp(self.encoding.jvp(pose.encoded, qd), pose.intermediates)
        return applied(mass_rate, qd) - self.lagrangian_gradient(pose, qd)

    def friction_torque(self, q: Tensor | NetworkPose, qd: Tensor) -> Tensor:
        """Return D(q, qd) qd, (..., n) [Nm, N]."""
        pose: NetworkPose = self.at(q, qd)
        layers = pose.prepared["friction"]
        return self.friction.forward(pose.encoded, qd, layers, qd.unsqueeze(-1)).squeeze(-1)

    def dissipation(self, q: Tensor | NetworkPose, qd: Tensor) -> Tensor:
        """Return D(q, qd), (..., n, n) [Nm s/rad, N s/m]."""
        pose: NetworkPose = self.at(q, qd)
        return self.friction.forward(pose.encoded, qd, pose.prepared["friction"], torch.eye(self.n).to(qd))

    def forward(self, t: Tensor, state: Tensor) -> Tensor:
        """Return the rate of (q, p), (..., 2 n), or of (q, p, tau), where tau is held."""
        q, p, tau = state.tensor_split((self.n, 2 * self.n), dim=-1)
        qd, force = self.port_hamiltonian_rhs(q, p, tau if tau.shape[-1] else None, self.prepare())
        return torch.cat([qd, force, torch.zeros_like(tau)], dim=-1)
