"""A port-Hamiltonian model of rigid bodies, each of which moves as four points do."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from spelgen.runtime.body_chain import BodyChain, Chain
from spelgen.runtime.friction_laws import FrictionConstants, FrictionLaws, turning
from spelgen.runtime.joints import vector
from spelgen.runtime.parts import Row
from spelgen.runtime.port_hamiltonian import PortHamiltonian, applied
from spelgen.runtime.rigid_body import InertialParameters


class RigidPrepared(NamedTuple):
    """What depends on the weights alone, worked out once for many states."""

    points: Tensor  # of the bodies in their own frames, columns of blocks, (4 bodies, 4 bodies)
    armature: Tensor  # what the rotors add to M, (n, n)
    friction: FrictionConstants
    residual: Any = None  # of what a model has beside rigid bodies


class Motion(NamedTuple):
    """What depends on q alone."""

    chain: Chain
    mass: Tensor  # M(q), (..., n, n)
    gravity: Tensor  # dV/dq of the bodies, (..., n)
    prepared: RigidPrepared
    varied: Tensor | float = 1.0  # how much more friction there is than the laws', (..., n)
    residual: Any = None  # of what a model has beside rigid bodies


class RigidBodyDynamics(PortHamiltonian):
    """Rigid bodies with trained inertial parameters, friction by laws, a trained torque offset.

    z, (..., n, K), is the state of friction's bristles [rad, m], and adds their energy to H; without it
    friction is that of joints that slide the way they move. armature: nominal, of the drives [kg m^2, kg].
    """

    kinds = (
        ("raw_armature", "armature", "kg m^2, kg"),
        ("raw_offset", "offset", "Nm, N"),
        ("raw_friction_compensation", "friction_compensation", "Nm s/rad, N s/m"),
    )

    def __init__(
        self, chain: BodyChain, bodies: InertialParameters, friction: FrictionLaws, armature: Row
    ) -> None:
        super().__init__()
        self.chain, self.bodies, self.friction = chain, bodies, friction
        self.elements = friction.reach.shape[1]
        self.nominal_armature = nn.Buffer(vector(armature))
        # 1 where the measured torque moves a joint, (n,)
        self.actuated = nn.Buffer(self.input_matrix(self.nominal_armature).any(dim=0).double())
        self.raw_armature = nn.Parameter(torch.zeros_like(self.actuated))  # its logarithm
        # of the measured torque, in units of the joints' usual friction
        self.raw_offset = nn.Parameter(torch.zeros_like(self.actuated))
        # in units of usual friction at usual speed; no parameter: only a fit to torques may find one
        self.raw_friction_compensation = nn.Buffer(torch.zeros_like(self.actuated))

    @property
    def inertial_parameters(self) -> Tensor:
        """By body (m, m c, Ixx, Ixy, Ixz, Iyy, Iyz, Izz) about its joint's frame, (bodies, 10)."""
        root = self.bodies.forward()
        row, column = torch.triu_indices(4, 4)
        xx, xy, xz, x, yy, yz, y, zz, z, m = (root @ root.mT)[..., row, column].unbind(dim=-1)
        return torch.stack([m, x, y, z, yy + zz, -xy, -xz, xx + zz, -yz, xx + yy], dim=-1)

    @property
    def armature(self) -> Tensor:
        """Armature, the drives' part of M's diagonal, (n,) [kg m^2, kg]."""
        return self.nominal_armature * self.raw_armature.exp()

    @property
    def viscous(self) -> Tensor:
        """Friction torque by velocity, (n,) [Nm s/rad, N s/m]."""
        return self.friction.prepare().viscous

    @property
    def coulomb(self) -> Tensor:
        """Dry friction, (n,) [Nm, N]."""
        return self.friction.prepare().coulomb

    @property
    def torque_offset(self) -> Tensor:
        """What the measured torque shows without any, (n,) [Nm, N]."""
        return self.raw_offset * self.friction.nominal * self.actuated

    @property
    def friction_compensation(self) -> Tensor:
        """What the drives add by velocity, unseen in the measured torque, (n,) [Nm s/rad, N s/m]."""
        return self.raw_friction_compensation * self.friction.nominal / self.friction.speed * self.actuated

    def prepare(self) -> RigidPrepared:
        """Return all that depends on the weights alone; holds until they change."""
        points = torch.ops.aten.block_diag([*self.bodies.forward()])
        return RigidPrepared(points, torch.diag_embed(self.armature), self.friction.prepare())

    def configuration(self, q: Tensor, prepared: RigidPrepared) -> Motion:
        """Return what depends on q alone."""
        chain, ratios = self.chain.forward(q, prepared.points), self.chain.ratios
        mass = ratios.mT @ (chain.jacobian @ chain.jacobian.mT) @ ratios + prepared.armature
        return Motion(chain, mass, applied(chain.jacobian, chain.weight) @ ratios, prepared)

    def potential_energy(self, q: Tensor | Motion, z: Tensor | None = None) -> Tensor:
        """Return V(q) and what bristles store, (...) [J]; zero for a mass at the base's origin."""
        pose: Motion = self.at(q)
        energy = (pose.chain.place.flatten(-3) * pose.chain.weight).sum(dim=-1)
        return energy if z is None else energy + pose.prepared.friction.stored_energy(z)

    def gravity(self, q: Tensor | Motion) -> Tensor:
        """Return dV/dq, (..., n) [Nm, N]."""
        pose: Motion = self.at(q)
        return pose.gravity

    def lagrangian_gradient(self, q: Tensor | Motion, qd: Tensor) -> Tensor:
        """Return d/dq of 1/2 qd^T M(q) qd - V(q), (..., n)."""
        pose: Motion = self.at(q, qd)
        return self.chain.kinetic_gradient(pose.chain, qd) - pose.gravity

    def nonlinear_effects(self, q: Tensor | Motion, qd: Tensor) -> Tensor:
        """Return the torque that holds qd steady without friction, (..., n), by d'Alembert's principle."""
        pose: Motion = self.at(q, qd)
        return applied(pose.chain.jacobian, self.chain.accelerations(pose.chain, qd)) @ self.chain.ratios

    def friction_torque(self, q: Tensor | Motion, qd: Tensor, *state: Tensor | None) -> Tensor:
        """Return the friction torque, (..., n) [Nm, N]; state: see ``FrictionConstants.torque``."""
        pose: Motion = self.at(q, qd)
        return pose.varied * pose.prepared.friction.torque(qd, pose.gravity, *state)

    def dissipation(self, q: Tensor | Motion, qd: Tensor) -> Tensor:
        """Return D(q, qd), (..., n, n) [Nm s/rad, N s/m]."""
        pose: Motion = self.at(q, qd)
        friction = pose.prepared.friction
        dry = friction.dry(qd, pose.gravity) * turning(qd, friction.coulomb_smoothing_velocity)
        return torch.diag_embed(pose.varied * (friction.viscosity(qd) + dry))

    def memory(self, qd: Tensor) -> Tensor:
        """Return z, (..., n, K), of drives that have long gone this way.

        Near the smoothing velocity they bear up to 7.4 % more than friction without z, far above it the same.
        """
        # bent as far as they go a few widths on: the rest of an algebraic turn would be a stiff transient
        direction = (qd / self.friction.prepare().coulomb_smoothing_velocity).tanh()
        return direction.unsqueeze(-1) * self.friction.reach

    def memory_rate(self, z: Tensor, qd: Tensor) -> Tensor:
        """Return z', (..., n, K): qd, and zero where |z| is the reach and would grow."""
        qd = qd.unsqueeze(-1)
        return qd * (qd.sign() * z < self.friction.reach)

    def memory_after(self, z: Tensor, displacement: Tensor) -> Tensor:
        """Return z after joints went one way by (..., n), exactly."""
        return (z + displacement.unsqueeze(-1)).clamp(-self.friction.reach, self.friction.reach)

    def forward(self, t: Tensor, state: Tensor) -> Tensor:
        """Return the rate of (q, p, z), (..., 2 n + n K), or of (q, p, z, tau), where tau is held.

        A state that is too short for z has none: friction is then that of joints which slide.
        """
        n, size = self.n, self.n * self.elements
        if state.shape[-1] < 2 * n + size:
            size = 0
        q, p, flat, tau = state.tensor_split((n, 2 * n, 2 * n + size), dim=-1)
        z = flat.reshape(*flat.shape[:-1], n, -1) if size else None
        qd, force = self.port_hamiltonian_rhs(q, p, tau if tau.shape[-1] else None, self.prepare(), z)
        if z is not None:
            flat = self.memory_rate(z, qd).flatten(-2)
        return torch.cat([qd, force, flat, torch.zeros_like(tau)], dim=-1)

    def input_force(self, pose: Motion, qd: Tensor, tau: Tensor) -> Tensor:
        """Return G (tau - torque offset) + friction compensation qd, (..., n) [Nm, N]."""
        return super().input_force(pose, qd, tau - self.torque_offset) + self.friction_compensation * qd
