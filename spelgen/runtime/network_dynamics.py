"""A port-Hamiltonian model whose functions of q are networks."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from spelgen.runtime.encoding import JointEncoding
from spelgen.runtime.joints import Joints
from spelgen.runtime.parts import Friction, Intermediates, Mass, Network
from spelgen.runtime.port_hamiltonian import PortHamiltonian, applied


class NetworkPrepared(NamedTuple):
    """What depends on the weights alone, by part."""

    mass: Any
    potential: Any  # a network's layers, or None
    friction: Any
    input: Any = None


class NetworkPose(NamedTuple):
    """What depends on q alone."""

    encoded: Tensor  # q as networks read it, see ``JointEncoding``
    mass: Tensor  # M(q), (..., n, n)
    intermediates: Intermediates  # what M's derivatives need
    prepared: NetworkPrepared


class NetworkDynamics(PortHamiltonian):
    """M and D of these parts; V is a network's, in units of ``scale`` [J], or zero where there is none."""

    def __init__(
        self, joints: Joints, mass: Mass, potential: Network | None, scale: float, friction: Friction
    ) -> None:
        super().__init__(joints)
        self.encoding, self.mass = JointEncoding(joints), mass
        self.potential, self.friction = potential, friction
        self.scale = nn.Buffer(torch.full((1, 1), scale, dtype=torch.float64))

    def prepare(self) -> NetworkPrepared:
        """Return all that depends on the weights alone."""
        layers = None
        if self.potential is not None:
            layers = self.potential.prepare(self.scale, 0 * self.scale[0])
        return NetworkPrepared(self.mass.prepare(), layers, self.friction.prepare())

    def configuration(self, q: Tensor, prepared: NetworkPrepared) -> NetworkPose:
        """Return what depends on q alone."""
        encoded = self.encoding.forward(q)
        mass, intermediates = self.mass.forward(encoded, prepared.mass)
        return NetworkPose(encoded, mass, intermediates, prepared)

    def potential_energy(self, q: Tensor | NetworkPose) -> Tensor:
        """Return V(q), (...) [J]."""
        pose: NetworkPose = self.at(q)
        if self.potential is None:
            return pose.encoded.new_zeros(pose.encoded.shape[:-1])
        return self.potential.forward(pose.encoded, pose.prepared.potential)[0].squeeze(-1)

    def gravity(self, q: Tensor | NetworkPose) -> Tensor:
        """Return dV/dq, (..., n) [Nm, N]."""
        pose: NetworkPose = self.at(q)
        return -self.lagrangian_gradient(pose, torch.zeros_like(pose.mass[..., 0]))

    def lagrangian_gradient(self, q: Tensor | NetworkPose, qd: Tensor) -> Tensor:
        """Return d/dq of 1/2 qd^T M(q) qd - V(q), (..., n)."""
        pose: NetworkPose = self.at(q, qd)
        by_encoded = self.mass.kinetic_vjp(qd, pose.intermediates)
        if self.potential is not None:
            intermediates = self.potential.forward(pose.encoded, pose.prepared.potential)[1]
            by_encoded = by_encoded - self.potential.vjp(intermediates, qd.new_ones(1))
        return self.encoding.vjp(pose.encoded, by_encoded)

    def nonlinear_effects(self, q: Tensor | NetworkPose, qd: Tensor) -> Tensor:
        """Return dM/dt qd - d/dq (1/2 qd^T M qd) + dV/dq, (..., n)."""
        pose: NetworkPose = self.at(q, qd)
        mass_rate = self.mass.jvp(self.encoding.jvp(pose.encoded, qd), pose.intermediates)
        return applied(mass_rate, qd) - self.lagrangian_gradient(pose, qd)

    def friction_torque(self, q: Tensor | NetworkPose, qd: Tensor) -> Tensor:
        """Return D(q, qd) qd, (..., n) [Nm, N]."""
        pose: NetworkPose = self.at(q, qd)
        return self.friction.forward(pose.encoded, qd, pose.prepared.friction, qd.unsqueeze(-1)).squeeze(-1)

    def dissipation(self, q: Tensor | NetworkPose, qd: Tensor) -> Tensor:
        """Return D(q, qd), (..., n, n) [Nm s/rad, N s/m]."""
        pose: NetworkPose = self.at(q, qd)
        return self.friction.forward(pose.encoded, qd, pose.prepared.friction, torch.eye(self.n).to(qd))
