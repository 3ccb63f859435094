"""A port-Hamiltonian model of rigid bodies, by the recursive Newton-Euler equations."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from spelgen.runtime.armature import Armature
from spelgen.runtime.friction_laws import FrictionConstants, FrictionLaws
from spelgen.runtime.joints import Joints, vector
from spelgen.runtime.parts import Input
from spelgen.runtime.port_hamiltonian import PortHamiltonian, applied
from spelgen.runtime.rigid_body import Bodies, InertialParameters, inertia_basis, skew, transform_table


class RigidPrepared(NamedTuple):
    """What depends on the weights alone, worked out once for many states."""

    inertia: Tensor  # spatial inertias, (bodies, 6, 6)
    armature: Tensor  # (n,)
    friction: FrictionConstants
    input: Tensor


class Motion(NamedTuple):
    """How the bodies may move at a position, each in its own frame."""

    maps: Tensor  # twists from the parent's frame, (..., bodies, 6, 6)
    twists: Tensor  # by joint velocity, (..., bodies, 6, n)
    weight: Tensor  # acceleration that stands for gravity, (..., bodies, 6)
    gravity: Tensor  # dV/dq, (..., n)


class RigidBodyDynamics(PortHamiltonian):
    """Rigid bodies with trained inertial parameters, friction by laws, a trained torque offset.

    Spatial vectors are (angular, linear), as in Featherstone, Rigid Body Dynamics Algorithms, 2008.
    """

    tables: Tensor
    axes: Tensor  # twist of a body by the velocity of its joint, (bodies, 6, n)
    ratios: Tensor
    offsets: Tensor
    basis: Tensor
    crossing: Tensor
    base: Tensor
    actuated: Tensor

    def __init__(
        self,
        joints: Joints,
        bodies: Bodies,
        gravity: tuple[float, float, float],
        input: Input,
    ) -> None:
        super().__init__()
        self.n, self.parents = joints.n, bodies.parent
        self.register_buffer(
            "tables", torch.stack([transform_table(bodies, k) for k in range(len(bodies.mass))])
        )
        axes = torch.zeros(len(bodies.mass), 6, self.n, dtype=torch.float64)
        for index, revolute in enumerate(bodies.revolute):
            axes[index, 2 if revolute else 5, bodies.joint[index]] = bodies.ratio[index]
        self.register_buffer("axes", axes)
        self.register_buffer("ratios", axes.sum(dim=1))
        self.register_buffer("offsets", vector(bodies.offset))
        self.register_buffer("basis", inertia_basis())
        crossing = torch.zeros(6, 6, 6, dtype=torch.float64)
        for axis, unit in enumerate(torch.eye(3, dtype=torch.float64)):
            crossing[axis, :3, :3] = crossing[axis, 3:, 3:] = skew(unit)
            crossing[3 + axis, 3:, :3] = skew(unit)
        self.register_buffer("crossing", crossing)
        self.register_buffer("base", vector((0, 0, 0, *(-g for g in gravity))))
        self.register_buffer("actuated", vector(float(x) for x in joints.actuated))
        self.inertial_parameters = InertialParameters(bodies)
        self.armature = Armature(joints)
        self.friction = FrictionLaws(joints)
        self.input: Any = input
        # of the measured torque, in units of the joints' usual friction
        self.raw_offset = nn.Parameter(torch.zeros(self.n, dtype=torch.float64))

    def torque_offset(self) -> Tensor:
        """What the measured torque shows without any, (n,) [Nm, N]."""
        return self.raw_offset * self.friction.nominal * self.actuated

    def prepare(self) -> RigidPrepared:
        """All that depends on the weights alone; holds until they change."""
        return RigidPrepared(
            inertia=torch.tensordot(self.inertial_parameters(), self.basis, dims=1),
            armature=self.armature(),
            friction=self.friction.prepare(),
            input=self.input.prepare(),
        )

    def configuration(self, q: Tensor, prepared: RigidPrepared) -> Motion:
        """How the bodies may move at q, and what they weigh there."""
        motion = self._motion(q)
        wrenches = applied(prepared.inertia, motion.weight)
        return motion._replace(gravity=self._by_joint(motion, wrenches))

    def _motion(self, q: Tensor) -> Motion:
        value = q @ self.ratios.mT + self.offsets
        terms = torch.stack([torch.ones_like(value), value.cos(), value.sin(), value], dim=-1)
        maps = (terms.unsqueeze(-2) @ self.tables.flatten(2)).reshape(*value.shape, 6, 6)
        still = torch.cat([torch.zeros_like(self.axes[0]), self.base.unsqueeze(-1)], dim=-1)
        own = torch.cat([self.axes, torch.zeros_like(self.axes[..., :1])], dim=-1)
        moved: list[Tensor] = []
        for index, parent in enumerate(self.parents):
            below = still if parent < 0 else moved[parent]
            moved.append(maps[..., index, :, :] @ below + own[index])
        columns = torch.stack(moved, dim=-3)
        return Motion(maps, columns[..., :-1], columns[..., -1], torch.zeros_like(q))

    def _cross(self, twist: Tensor) -> Tensor:
        """What a frame with this twist makes of a constant twist in it, (..., 6, 6)."""
        rows = twist @ self.crossing.flatten(1)
        return rows.reshape(*twist.shape[:-1], 6, 6)

    @staticmethod
    def _by_joint(motion: Motion, wrenches: Tensor) -> Tensor:
        """Joint torques, (..., n), that wrenches on the bodies, (..., bodies, 6), stand for."""
        return (wrenches.unsqueeze(-2) @ motion.twists).squeeze(-2).sum(dim=-2)

    def mass_at(self, at: Motion, prepared: RigidPrepared) -> tuple[Tensor, None]:
        """M(q), (..., n, n)."""
        inertia = (at.twists.mT @ (prepared.inertia @ at.twists)).sum(dim=-3)
        return inertia + torch.diag(prepared.armature), None

    def energy_at(self, at: Motion, prepared: RigidPrepared) -> Tensor:
        """V(q), (...) [J]; zero for a mass at the base's origin."""
        inertia, height = prepared.inertia, at.maps.new_zeros(at.maps.shape[:-3])
        placed: list[Tensor] = []
        for index, parent in enumerate(self.parents):
            own = at.maps[..., index, :, :]
            placed.append(own if parent < 0 else own @ placed[parent])
            # in the base's frame the moment of mass stands in the inertia's upper right block
            seen = placed[index].mT @ (inertia[index] @ placed[index])
            moment = torch.stack([seen[..., 2, 4], seen[..., 0, 5], seen[..., 1, 3]], dim=-1)
            height = height + moment @ self.base[3:]
        return height

    def gravity_at(self, at: Motion, prepared: RigidPrepared) -> Tensor:
        """dV/dq, (..., n) [Nm, N]."""
        return at.gravity

    def _accelerations(self, motion: Motion, qd: Tensor, twists: Tensor) -> Tensor:
        """The bodies' accelerations at steady qd, gravity taken as one, (..., bodies, 6)."""
        turned = applied(self._cross(twists) @ self.axes, qd.unsqueeze(-2))
        found: list[Tensor] = []
        for index, parent in enumerate(self.parents):
            own = turned[..., index, :]
            if parent >= 0:
                own = own + applied(motion.maps[..., index, :, :], found[parent])
            found.append(own)
        return torch.stack(found, dim=-2) + motion.weight

    def lagrangian_gradient(self, at: Motion, qd: Tensor, residuals: Any, prepared: RigidPrepared) -> Tensor:
        """d/dq of 1/2 qd^T M(q) qd - V(q), (..., n).

        The kinetic part: the momentum of all that a joint carries, by what its displacement adds to
        their twist.
        """
        twists = applied(at.twists, qd.unsqueeze(-2))
        turned = self._cross(twists) @ self.axes
        carried = list(applied(prepared.inertia, twists).unbind(dim=-2))
        for index in reversed(range(len(self.parents))):
            parent = self.parents[index]
            if parent >= 0:
                back = at.maps[..., index, :, :].mT
                carried[parent] = carried[parent] + applied(back, carried[index])
        momenta = torch.stack(carried, dim=-2)
        return (momenta.unsqueeze(-2) @ turned).squeeze(-2).sum(dim=-2) - at.gravity

    def nonlinear_at(self, at: Motion, qd: Tensor, residuals: Any, prepared: RigidPrepared) -> Tensor:
        """The torque that holds qd steady without friction, (..., n)."""
        twists = applied(at.twists, qd.unsqueeze(-2))
        accelerations = self._accelerations(at, qd, twists)
        momenta = applied(prepared.inertia, twists)
        wrenches = applied(prepared.inertia, accelerations)
        return self._by_joint(at, wrenches - applied(self._cross(twists).mT, momenta))

    def regressor(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """Y, (..., n, 10 bodies): Y @ inertial parameters is the bodies' torque."""
        motion = self._motion(q)
        twists = applied(motion.twists, qd.unsqueeze(-2))
        accelerations = self._accelerations(motion, qd, twists)
        accelerations = accelerations + applied(motion.twists, qdd.unsqueeze(-2))
        # by body and parameter: (..., bodies, 6, 10)
        rises = torch.tensordot(accelerations, self.basis, dims=([-1], [2])).mT
        momenta = torch.tensordot(twists, self.basis, dims=([-1], [2])).mT
        wrenches = rises - self._cross(twists).mT @ momenta
        rows: Tensor = (motion.twists.mT @ wrenches).transpose(-3, -2)
        return rows.reshape(*q.shape, 10 * len(self.parents))

    def friction_at(self, at: Motion, qd: Tensor, prepared: RigidPrepared) -> Tensor:
        """D(q, qd) qd, (..., n) [Nm, N]."""
        torque: Tensor = self.friction(qd, at.gravity, prepared.friction)
        return torque

    def dissipation_at(self, at: Motion, qd: Tensor, prepared: RigidPrepared) -> Tensor:
        """D(q, qd), (..., n, n), diagonal."""
        return torch.diag_embed(self.friction.resistance(qd, at.gravity, prepared.friction))

    def input_at(self, at: Motion, prepared: RigidPrepared) -> Tensor:
        """G, (..., n, n)."""
        matrix: Tensor = self.input(at.gravity, prepared.input)
        return matrix

    def input_force(self, at: Motion, tau: Tensor, prepared: RigidPrepared) -> Tensor:
        """G (tau - torque offset), (..., n) [Nm, N]."""
        force: Tensor = self.input.force(at.gravity, tau - self.torque_offset(), prepared.input)
        return force

    def input_torque(self, at: Motion, force: Tensor, prepared: RigidPrepared) -> Tensor:
        """The tau, (..., n), that makes this force."""
        tau: Tensor = self.input.solve(at.gravity, force, prepared.input)
        return tau + self.torque_offset()
