"""A port-Hamiltonian model of rigid bodies, by the recursive Newton-Euler equations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from spelgen.runtime.armature import Armature
from spelgen.runtime.friction_laws import FrictionConstants, FrictionLaws
from spelgen.runtime.joints import Joints, vector
from spelgen.runtime.parts import DriveInput
from spelgen.runtime.port_hamiltonian import PortHamiltonian, applied
from spelgen.runtime.rigid_body import Bodies, InertialParameters, inertia_basis, skew, transform_table


def block_diagonal(blocks: Tensor) -> Tensor:
    """The matrix, (k m, k m), with these blocks, (k, m, m), on its diagonal."""
    k, m, _ = blocks.shape
    own = torch.eye(k, dtype=blocks.dtype, device=blocks.device)
    return (own[:, None, :, None] * blocks[:, :, None, :]).reshape(k * m, k * m)


class RigidPrepared(NamedTuple):
    """What depends on the weights alone, worked out once for many states."""

    inertia: Tensor  # spatial inertias on the diagonal, (6 bodies, 6 bodies)
    armature: Tensor  # what the rotors add to M, (n, n)
    friction: FrictionConstants
    input: Tensor
    residual: Any = None  # of what a model has beside rigid bodies


class Motion(NamedTuple):
    """How the bodies may move at a position, each in its own frame; 6 numbers a body, side by side."""

    terms: Tensor  # cos and sin of a body's angle, or its displacement and 0, (..., bodies, 2)
    twists: Tensor  # by joint velocity, (..., n, 6 bodies)
    weight: Tensor  # acceleration that stands for gravity, (..., 6 bodies)
    gravity: Tensor  # dV/dq of the bodies, (..., n)
    q: Tensor


class RigidBodyDynamics(PortHamiltonian):
    """Rigid bodies with trained inertial parameters, friction by laws, a trained torque offset.

    Spatial vectors are (angular, linear), as in Featherstone, Rigid Body Dynamics Algorithms, 2008.
    They are rows here, and all bodies' stand side by side: so most products are of one large matrix.
    """

    forth: Tensor  # takes twists from the parent's frame: constant part, that of each term, (bodies, 6, 18)
    back: Tensor  # takes wrenches to the parent's frame, likewise
    axes: Tensor  # twists of the bodies by joint velocity alone, (n, 6 bodies)
    turning: Tensor  # takes a body's twist to how its joint's axis turns, (6 bodies, 6 bodies)
    owner: Tensor  # sums six numbers of a body to its joint, (6 bodies, n)
    revolute: Tensor
    ratios: Tensor  # (bodies, n)
    offsets: Tensor
    basis: Tensor
    crossing: Tensor
    base: Tensor
    actuated: Tensor
    motors: Tensor  # C: the drives' speeds are C qd, (n, n)
    loads: Tensor  # its inverse
    raw_friction_compensation: Tensor

    def __init__(
        self,
        joints: Joints,
        bodies: Bodies,
        gravity: tuple[float, float, float],
        input: DriveInput,
        reach: Sequence[Sequence[float]] = (),
    ) -> None:
        super().__init__()
        self.n, self.elements, self.parents = joints.n, len(reach[0]) if reach else 0, bodies.parent
        count = len(bodies.parent)
        tables = torch.stack([transform_table(bodies, index) for index in range(count)])
        self.register_buffer("forth", tables.mT.transpose(1, 2).flatten(2))
        self.register_buffer("back", tables.transpose(1, 2).flatten(2))
        crossing = torch.zeros(6, 6, 6, dtype=torch.float64)
        for axis, unit in enumerate(torch.eye(3, dtype=torch.float64)):
            crossing[axis, :3, :3] = crossing[axis, 3:, 3:] = skew(unit)
            crossing[3 + axis, 3:, :3] = skew(unit)
        axes = torch.zeros(count, 6, dtype=torch.float64)
        ratios = torch.zeros(count, self.n, dtype=torch.float64)
        for index, revolute in enumerate(bodies.revolute):
            axes[index, 2 if revolute else 5] = bodies.ratio[index]
            ratios[index, bodies.joint[index]] = bodies.ratio[index]
        owner = (ratios != 0).double().repeat_interleave(6, dim=0)
        self.register_buffer("axes", owner.mT * axes.flatten())
        self.register_buffer("turning", block_diagonal(torch.stack([crossing @ axis for axis in axes])))
        self.register_buffer("owner", owner)
        self.register_buffer("revolute", vector(float(each) for each in bodies.revolute))
        self.register_buffer("ratios", ratios)
        self.register_buffer("offsets", vector(bodies.offset))
        self.register_buffer("basis", inertia_basis())
        self.register_buffer("crossing", crossing)
        self.register_buffer("base", vector((0, 0, 0, *(-g for g in gravity))))
        self.register_buffer("actuated", vector(float(x) for x in joints.actuated))
        self.inertial_parameters = InertialParameters(bodies)
        self.armature = Armature(joints)
        self.friction = FrictionLaws(joints, reach)
        self.input = input
        self.register_buffer("motors", self.input.motor_speeds())
        self.register_buffer("loads", torch.linalg.inv(self.motors))
        # of the measured torque, in units of the joints' usual friction
        self.raw_offset = nn.Parameter(torch.zeros(self.n, dtype=torch.float64))
        # in units of usual friction at usual speed; no parameter: only a fit to torques may find one
        self.register_buffer("raw_friction_compensation", torch.zeros(self.n, dtype=torch.float64))

    def torque_offset(self) -> Tensor:
        """What the measured torque shows without any, (n,) [Nm, N]."""
        return self.raw_offset * self.friction.nominal * self.actuated

    def friction_compensation(self) -> Tensor:
        """What the drives add by velocity, unseen in the measured torque, (n,) [Nm s/rad, N s/m]."""
        return self.raw_friction_compensation * self.friction.nominal / self.friction.speed * self.actuated

    def prepare(self, definite: bool = True) -> RigidPrepared:
        """All that depends on the weights alone; holds until they change."""
        inertia = torch.tensordot(self.inertial_parameters(), self.basis, dims=1)
        return RigidPrepared(
            inertia=block_diagonal(inertia),
            armature=self.motors.mT @ (self.armature().unsqueeze(-1) * self.motors),
            friction=self.friction.prepare(),
            input=self.input.prepare(),
        )

    def configuration(self, q: Tensor, prepared: RigidPrepared) -> Motion:
        """How the bodies may move at q, and what they weigh there."""
        motion = self._motion(q)
        return motion._replace(gravity=applied(motion.twists, motion.weight @ prepared.inertia))

    def _motion(self, q: Tensor) -> Motion:
        value = q @ self.ratios.mT + self.offsets
        sliding = 1 - self.revolute
        terms = torch.stack(
            [self.revolute * value.cos() + sliding * value, self.revolute * value.sin()], dim=-1
        )
        rows = torch.cat([torch.zeros_like(self.axes[:, :6]), self.base.unsqueeze(0)])
        own = torch.cat([self.axes, torch.zeros_like(self.axes[:1])]).reshape(self.n + 1, -1, 6)
        moved: list[Tensor] = []
        for index, parent in enumerate(self.parents):
            below = rows.expand(*q.shape[:-1], -1, -1) if parent < 0 else moved[parent]
            moved.append(self._carried(self.forth[index], below, terms[..., index, :]) + own[:, index])
        columns = torch.cat(moved, dim=-1)
        return Motion(terms, columns[..., :-1, :], columns[..., -1, :], torch.zeros_like(q), q)

    @staticmethod
    def _carried(table: Tensor, rows: Tensor, terms: Tensor) -> Tensor:
        """Rows, (..., k, 6), taken to a neighbour's frame."""
        constant, by_cos, by_sin = (rows @ table).chunk(3, dim=-1)
        cos, sin = terms.unsqueeze(-2).chunk(2, dim=-1)
        return constant + cos * by_cos + sin * by_sin

    def mass_at(self, at: Motion, prepared: RigidPrepared) -> tuple[Tensor, None]:
        """M(q), (..., n, n)."""
        return (at.twists @ prepared.inertia) @ at.twists.mT + prepared.armature, None

    def energy_at(self, at: Motion, prepared: RigidPrepared) -> Tensor:
        """V(q), (...) [J]; zero for a mass at the base's origin."""
        height = at.terms.new_zeros(at.terms.shape[:-2])
        still = torch.eye(6, dtype=height.dtype, device=height.device).expand(*height.shape, 6, 6)
        placed: list[Tensor] = []
        for index, parent in enumerate(self.parents):
            below = still if parent < 0 else placed[parent]
            placed.append(self._carried(self.forth[index], below, at.terms[..., index, :]))
            own = slice(6 * index, 6 * index + 6)
            # in the base's frame the moment of mass stands in the inertia's upper right block
            seen = placed[index] @ prepared.inertia[own, own] @ placed[index].mT
            moment = torch.stack([seen[..., 2, 4], seen[..., 0, 5], seen[..., 1, 3]], dim=-1)
            height = height + moment @ self.base[3:]
        return height

    def gravity_at(self, at: Motion, prepared: RigidPrepared) -> Tensor:
        """dV/dq, (..., n) [Nm, N]."""
        return at.gravity

    def _velocities(self, motion: Motion, qd: Tensor) -> Tensor:
        """The bodies' twists, (..., 6 bodies)."""
        return (qd.unsqueeze(-2) @ motion.twists).squeeze(-2)

    def _accelerations(self, motion: Motion, qd: Tensor, twists: Tensor) -> Tensor:
        """The bodies' accelerations at steady qd, gravity taken as one, (..., 6 bodies)."""
        turned = (twists @ self.turning) * (qd @ self.owner.mT)
        found: list[Tensor] = []
        for index, (parent, own) in enumerate(
            zip(self.parents, turned.chunk(len(self.parents), dim=-1), strict=True)
        ):
            if parent >= 0:
                below = found[parent].unsqueeze(-2)
                own = own + self._carried(self.forth[index], below, motion.terms[..., index, :]).squeeze(-2)
            found.append(own)
        return torch.cat(found, dim=-1) + motion.weight

    def lagrangian_gradient(self, at: Motion, qd: Tensor, residuals: Any, prepared: RigidPrepared) -> Tensor:
        """d/dq of 1/2 qd^T M(q) qd - V(q), (..., n).

        The kinetic part: the momentum of all that a joint carries, by what its displacement adds to
        their twist.
        """
        twists = self._velocities(at, qd)
        carried = list((twists @ prepared.inertia).chunk(len(self.parents), dim=-1))
        for index in reversed(range(len(self.parents))):
            parent = self.parents[index]
            if parent >= 0:
                below = self._carried(self.back[index], carried[index].unsqueeze(-2), at.terms[..., index, :])
                carried[parent] = carried[parent] + below.squeeze(-2)
        turned = twists @ self.turning
        return (torch.cat(carried, dim=-1) * turned) @ self.owner - at.gravity

    def nonlinear_at(self, at: Motion, qd: Tensor, residuals: Any, prepared: RigidPrepared) -> Tensor:
        """The torque that holds qd steady without friction, (..., n)."""
        twists = self._velocities(at, qd)
        wrenches = self._accelerations(at, qd, twists) @ prepared.inertia
        momenta = self._by_body(twists @ prepared.inertia)
        turned = applied(self._cross(self._by_body(twists)).mT, momenta)
        return applied(at.twists, wrenches - turned.flatten(-2))

    def _by_body(self, rows: Tensor) -> Tensor:
        """(..., 6 bodies) as (..., bodies, 6)."""
        return rows.reshape(*rows.shape[:-1], len(self.parents), 6)

    def _cross(self, twist: Tensor) -> Tensor:
        """What a frame with this twist makes of a constant twist in it, (..., 6, 6)."""
        rows = twist @ self.crossing.flatten(1)
        return rows.reshape(*twist.shape[:-1], 6, 6)

    def regressor(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """Y, (..., n, 10 bodies): Y @ inertial parameters is the bodies' torque."""
        motion = self._motion(q)
        twists = self._velocities(motion, qd)
        accelerations = self._accelerations(motion, qd, twists) + self._velocities(motion, qdd)
        twists = self._by_body(twists)
        # by body and parameter: (..., bodies, 6, 10)
        rises = torch.tensordot(self._by_body(accelerations), self.basis, dims=([-1], [2])).mT
        momenta = torch.tensordot(twists, self.basis, dims=([-1], [2])).mT
        wrenches = rises - self._cross(twists).mT @ momenta
        columns = self._by_body(motion.twists).transpose(-3, -2)  # (..., bodies, n, 6)
        rows: Tensor = (columns @ wrenches).transpose(-3, -2)
        return rows.reshape(*q.shape, 10 * len(self.parents))

    def residual_torque(self, q: Tensor, qd: Tensor, qdd: Tensor, prepared: RigidPrepared) -> Tensor:
        """What else than bodies, drives and friction takes torque, (..., n) [Nm, N]: nothing."""
        return torch.zeros_like(q)

    def friction_factor(self, q: Tensor) -> Tensor:
        """How much more friction the drives have at q than their laws say, (..., n): nowhere any."""
        return torch.ones_like(q)

    def friction_at(self, at: Motion, qd: Tensor, prepared: RigidPrepared, z: Tensor | None = None) -> Tensor:
        """The friction torque C^T f(C qd), (..., n) [Nm, N]."""
        torque: Tensor = self.friction(qd @ self.motors.mT, at.gravity @ self.loads, prepared.friction, z)
        return (self.friction_factor(at.q) * torque) @ self.motors

    def stored_energy(self, z: Tensor, prepared: RigidPrepared) -> Tensor:
        """What the bristles give back, (...) [J]."""
        return self.friction.stored_energy(z, prepared.friction)

    def memory(self, qd: Tensor) -> Tensor:
        """z, (..., n, K), of drives that have long gone this way."""
        return self.friction.sliding(qd @ self.motors.mT)

    def memory_rate(self, qd: Tensor, z: Tensor) -> Tensor:
        """z', (..., n, K)."""
        return self.friction.bristles.rate(qd @ self.motors.mT, z)

    def memory_after(self, z: Tensor, displacement: Tensor) -> Tensor:
        """z after joints went one way by (..., n), exactly."""
        return self.friction.bristles.moved(z, displacement @ self.motors.mT)

    def dissipation_at(self, at: Motion, qd: Tensor, prepared: RigidPrepared) -> Tensor:
        """D(q, qd), (..., n, n), diagonal where each drive moves its own joint alone."""
        speeds, loads = qd @ self.motors.mT, at.gravity @ self.loads
        resistance = self.friction.resistance(speeds, loads, prepared.friction)
        resistance = self.friction_factor(at.q) * resistance
        return self.motors.mT @ (resistance.unsqueeze(-1) * self.motors)

    def input_at(self, at: Motion, prepared: RigidPrepared) -> Tensor:
        """G, (..., n, n)."""
        matrix: Tensor = self.input(at.gravity, prepared.input)
        return matrix

    def input_force(self, at: Motion, qd: Tensor, tau: Tensor, prepared: RigidPrepared) -> Tensor:
        """G (tau - torque offset) + friction compensation qd, (..., n) [Nm, N]."""
        force: Tensor = self.input.force(at.gravity, tau - self.torque_offset(), prepared.input)
        return force + self.friction_compensation() * qd

    def input_torque(self, at: Motion, qd: Tensor, force: Tensor, prepared: RigidPrepared) -> Tensor:
        """The tau, (..., n), that is measured while the drives make this force."""
        shown = force - self.friction_compensation() * qd
        tau: Tensor = self.input.solve(at.gravity, shown, prepared.input)
        return tau + self.torque_offset()
