r"""Port-Hamiltonian model of an arm with 3 joints, written by `spelgen build`.

45 learned functions of q make M^-1 over all axes.
The potential energy depends on joints 1-3.
Sizes and starting values are the URDF's inertials.

Mass matrix: the joints each entry depends on, C where it is constant, . where it is always zero.

    2,3
    3    C
    2,3  .    C

Joints, in the order of q, qd and tau:

    1  "joint1"  revolute   rad, Nm  -2.96706 .. 2.96706
    2  "joint2"  prismatic  m, N     0.305 .. 1.27
    3  "joint3"  revolute   rad, Nm  -2.96706 .. 2.96706
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor, nn

FACTS = r"""{"robot": "rpr", "urdf": "rpr.urdf",
 "urdf_sha256": "aaacb65e5fa6a4caf626114ddf8869514f479b568dae43957e41214d3c6eff8d",
 "spec_sha256": "d6dad934a75884d2aac3b6ac8d416f824749ba5567be3358835a594118798460",
 "options": {"angle_tolerance": 0.002, "assume": "kinematics", "depth": 2, "design": null, "joints": null,
  "net": "mlp", "preset": "phnode", "tip": null, "width": 64},
 "joints": {"joint1": "revolute", "joint2": "prismatic", "joint3": "revolute"}}"""


class Model(nn.Module):
    """The arm's dynamics: 45 learned functions of q make M^-1 over all axes.

    q, qd, qdd, tau and p are (..., n), with any leading dimensions; rad and Nm, m and N if prismatic. For all
    weights M is positive definite, D positive semi-definite. ``prepared``: what ``prepare`` gave, for speed.
    """

    n = 3
    joint_names = ("joint1", "joint2", "joint3")
    joint_types = ("revolute", "prismatic", "revolute")

    def __init__(self, seed: int = 0, dtype: torch.dtype = torch.float64) -> None:
        super().__init__()
        joints = Joints(
            revolute=(True, False, True), center=(0.0, 0.7875, 0.0), reach=(2.96706, 0.4825, 2.96706),
            speed=(3.0, 1.0, 6.0), friction=(0.4, 0.4, 0.4), armature=(2.19, 0.782, 0.106),
            gear=(1.0, 1.0, 1.0), actuated=(True, True, True),
        )  # fmt: skip
        generator = torch.Generator().manual_seed(seed)
        encoding = JointEncoding(joints)
        mass = DenseMass(
            joints, mean=((139.887,), (-0.00167665, 5.33), (-0.00154309, 0.0, 0.0101411)),
            network=MaskedMLP(
                lie_group_input(joints, (0.02, 1.0, 0.518)), unit_joints([range(3)] * 45, width=64, depth=2),
                generator,
            ),
        )  # fmt: skip
        network = MaskedMLP(
            lie_group_input(joints, (0.02, 0.02, 1.0)), unit_joints(((0, 1, 2),), width=32, depth=2),
            generator,
        )  # fmt: skip
        potential = LearnedPotential(0.703291, network)
        friction = DenseFriction(
            joints,
            MaskedMLP(
                with_velocities(lie_group_input(joints, (0.1, 0.1, 0.1)), joints, 3),
                unit_joints([range(3)] * 45, width=64, depth=2), generator,
            ),
            axes=3,
        )  # fmt: skip
        self.dynamics = NetworkDynamics(
            encoding, mass, potential, friction,
            DenseInput(
                joints,
                MaskedMLP(
                    lie_group_input(joints, (1.0, 1.0, 1.0)), unit_joints([range(3)] * 9, width=64, depth=2),
                    generator,
                ),
            ),
        )  # fmt: skip
        self.to(dtype)

    def prepare(self, definite: bool = True) -> Any:
        """All that depends on the weights alone, until they change; M made ``definite``, or as learned."""
        return self.dynamics.prepare(definite)

    def mass_matrix(self, q: Tensor, prepared: Any = None) -> Tensor:
        """M(q), (..., n, n) [kg m^2, kg m, kg]."""
        return self.dynamics.mass_matrix(q, prepared)

    def potential_energy(self, q: Tensor) -> Tensor:
        """V(q), (...) [J]."""
        return self.dynamics.potential_energy(q)

    def gravity(self, q: Tensor) -> Tensor:
        """dV/dq, (..., n) [Nm, N]."""
        return self.dynamics.gravity(q)

    def nonlinear_effects(self, q: Tensor, qd: Tensor) -> Tensor:
        """Coriolis, centrifugal and gravity torque, (..., n) [Nm, N]."""
        return self.dynamics.nonlinear_effects(q, qd)

    def friction_torque(self, q: Tensor, qd: Tensor, z: Tensor | None = None) -> Tensor:
        """D(q, qd) qd, or what friction is with its memory at z, (..., n) [Nm, N]."""
        return self.dynamics.friction_torque(q, qd, z)

    def dissipation(self, q: Tensor, qd: Tensor) -> Tensor:
        """D(q, qd), (..., n, n) [Nm s/rad, N s/m]."""
        return self.dynamics.dissipation(q, qd)

    def input_matrix(self, q: Tensor) -> Tensor:
        """G(q), (..., n, n): joint torques by inputs."""
        return self.dynamics.input_matrix(q)

    def momentum(self, q: Tensor, qd: Tensor, prepared: Any = None) -> Tensor:
        """p = M(q) qd, (..., n)."""
        return applied(self.mass_matrix(q, prepared), qd)

    def velocity(self, q: Tensor, p: Tensor, prepared: Any = None) -> Tensor:
        """qd = M(q)^-1 p, (..., n)."""
        return solved(self.mass_matrix(q, prepared), p)

    def hamiltonian(self, q: Tensor, p: Tensor, z: Tensor | None = None) -> Tensor:
        """H = 1/2 p^T M(q)^-1 p + V(q), (...) [J], and what friction's memory stores."""
        return self.dynamics.hamiltonian(q, p, z)

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor, z: Tensor | None = None) -> Tensor:
        """qdd, (..., n), under the input tau."""
        return self.dynamics.forward_dynamics(q, qd, tau, z)

    def inverse_dynamics(self, q: Tensor, qd: Tensor, qdd: Tensor, z: Tensor | None = None) -> Tensor:
        """The input, (..., n), that gives qdd."""
        return self.dynamics.inverse_dynamics(q, qd, qdd, z)

    def forward(self, t: Tensor, state: Tensor) -> Tensor:
        """The rate of (q, p, z), or of (q, p, z, tau), where tau is held; z is flat, (..., n K)."""
        return self.dynamics.state_rate(state)

    def port_hamiltonian_rhs(
        self, q: Tensor, p: Tensor, tau: Tensor | None, prepared: Any, z: Tensor | None = None
    ) -> State:
        """q' = dH/dp and p' = -dH/dq - D dH/dp + G tau, (..., n)."""
        return self.dynamics.port_hamiltonian_rhs(q, p, tau, prepared, z)

    def to_group(self, q: Tensor) -> list[Tensor]:
        """By joint, R in SO(3), (..., 3, 3), or r in R^3, (..., 3), if prismatic; z is its axis."""
        return to_group(q, self.joint_types)

    def from_group(self, parts: list[Tensor]) -> Tensor:
        """q, (..., n), with angles in [-pi, pi]; the inverse of ``to_group``."""
        return from_group(parts, self.joint_types)


# ---- spelgen's runtime, as it stands in the package: the same for every arm ----


class Joints(NamedTuple):
    """The joints, an entry for each; angles in rad and torques in Nm, lengths in m and forces in N."""

    revolute: tuple[bool, ...]
    center: tuple[float, ...]  # a prismatic joint is encoded as (q - center) / reach
    reach: tuple[float, ...]
    speed: tuple[float, ...]  # usual velocity
    friction: tuple[float, ...]  # usual size of the friction torque
    armature: tuple[float, ...]  # nominal rotor inertia times gear squared [kg m^2, kg]
    gear: tuple[float, ...]  # turns of the motor in a turn of the joint
    actuated: tuple[bool, ...]

    @property
    def n(self) -> int:
        """The number of joints."""
        return len(self.revolute)


def vector(values: Iterable[float]) -> Tensor:
    """The values as a float64 tensor."""
    return torch.tensor(list(values), dtype=torch.float64)


class Network(Protocol):
    """Learned functions y of an encoding, each of its own joints, with derivatives written out."""

    def prepare(self, output_map: Tensor, offset: Tensor) -> Any:
        """The weights made ready for many states, for offset + output_map y in place of y."""

    def __call__(self, encoded: Tensor, layers: Any) -> tuple[Tensor, Any]:
        """offset + output_map y, (..., rows); and residuals, which ``vjp`` and ``jvp`` need."""

    def vjp(self, residuals: Any, cotangent: Tensor) -> Tensor:
        """cotangent, (..., rows), times d/d encoded."""

    def jvp(self, residuals: Any, tangent: Tensor) -> Tensor:
        """d/d encoded times the encoding's tangent, (..., rows)."""


def unit_joints(
    outputs: Sequence[Sequence[int]], width: int, depth: int, least: int = 1
) -> tuple[tuple[frozenset[int], ...], ...]:
    """The joints that each unit may read, layer by layer: ``depth`` hidden layers, then the outputs.

    A hidden layer has ``width`` units, shared out in proportion to how many outputs read the same
    joints, ``least`` or more for each such group.
    """
    counts = Counter(tuple(joints) for joints in outputs)
    groups = sorted(counts, key=lambda each: (len(each), each))
    ideal = [width * counts[joints] / len(outputs) for joints in groups]
    units = [max(least, round(size)) for size in ideal]
    # rounding may have taken or left a unit or two: those who gained most give, who lost most take
    while sum(units) > width and max(units) > least:
        gained = [
            number - size if number > least else -width for number, size in zip(units, ideal, strict=True)
        ]
        units[gained.index(max(gained))] -= 1
    while sum(units) < width:
        lost = [size - number for number, size in zip(units, ideal, strict=True)]
        units[lost.index(max(lost))] += 1
    hidden = tuple(frozenset(g) for g, number in zip(groups, units, strict=True) for _ in range(number))
    return (*((hidden,) * depth), tuple(frozenset(joints) for joints in outputs))


def solved(matrix: Tensor, right: Tensor) -> Tensor:
    """matrix^-1 right, (..., n)."""
    # its derivative costs one more solution; a Cholesky factor's would cost several times that
    solution: Tensor = torch.linalg.solve(matrix, right.unsqueeze(-1))
    return solution.squeeze(-1)


def applied(matrix: Tensor, vector: Tensor) -> Tensor:
    """matrix vector, (..., n)."""
    if vector.dim() == 1:  # fewer steps, which is what one state costs
        return matrix @ vector
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


State = tuple[Tensor, Tensor]  # q and p, or how fast they change


class PortHamiltonian(nn.Module):
    """q' = dH/dp and p' = -dH/dq - D dH/dp + G tau, with H = 1/2 p^T M(q)^-1 p + V(q).

    The port-Hamiltonian form (van der Schaft and Jeltsema, Port-Hamiltonian Systems Theory, 2014).
    Where friction remembers, z, (..., n, K), is part of the state and adds its energy to H; without
    it friction is that of a joint that slides the way it moves.
    ``prepared`` is what ``prepare`` gave: all that depends on the weights alone. ``at`` is what
    ``configuration`` gave: all that is computed of q alone. Shapes: q, qd, tau, p are (..., n).
    """

    n: int
    elements: int  # K, of friction's memory at a joint

    def prepare(self, definite: bool = True) -> Any:
        """All that depends on the weights alone; holds until they change.

        Without ``definite`` M is left as learned: for the weak form, whose velocities are measured.
        """
        raise NotImplementedError

    def configuration(self, q: Tensor, prepared: Any) -> Any:
        """All that is computed of q alone."""
        raise NotImplementedError

    def mass_at(self, at: Any, prepared: Any) -> tuple[Tensor, Any]:
        """M(q), (..., n, n), and what its derivatives need."""
        raise NotImplementedError

    def energy_at(self, at: Any, prepared: Any) -> Tensor:
        """V(q), (...) [J]."""
        raise NotImplementedError

    def gravity_at(self, at: Any, prepared: Any) -> Tensor:
        """dV/dq, (..., n) [Nm, N]."""
        raise NotImplementedError

    def lagrangian_gradient(self, at: Any, qd: Tensor, residuals: Any, prepared: Any) -> Tensor:
        """d/dq of 1/2 qd^T M(q) qd - V(q), (..., n)."""
        raise NotImplementedError

    def nonlinear_at(self, at: Any, qd: Tensor, residuals: Any, prepared: Any) -> Tensor:
        """The torque that holds qd steady without friction: Coriolis, centrifugal and gravity."""
        raise NotImplementedError

    def friction_at(self, at: Any, qd: Tensor, prepared: Any, z: Tensor | None = None) -> Tensor:
        """The friction torque, (..., n) [Nm, N]: D(q, qd) qd, or that of bristles at z."""
        raise NotImplementedError

    def stored_energy(self, z: Tensor, prepared: Any) -> Tensor:
        """What friction's memory gives back, (...) [J]."""
        raise NotImplementedError

    def memory(self, qd: Tensor) -> Tensor:
        """z, (..., n, K), of joints that have long gone this way."""
        return qd.unsqueeze(-1)[..., :0]

    def memory_rate(self, qd: Tensor, z: Tensor) -> Tensor:
        """z', (..., n, K)."""
        return z

    def memory_after(self, z: Tensor, displacement: Tensor) -> Tensor:
        """z after joints went one way by (..., n), exactly."""
        return z

    def dissipation_at(self, at: Any, qd: Tensor, prepared: Any) -> Tensor:
        """D(q, qd), (..., n, n)."""
        raise NotImplementedError

    def input_at(self, at: Any, prepared: Any) -> Tensor:
        """G, (..., n, n)."""
        raise NotImplementedError

    def input_force(self, at: Any, qd: Tensor, tau: Tensor, prepared: Any) -> Tensor:
        """What the drives do at qd under the input tau: G tau, (..., n) [Nm, N]."""
        raise NotImplementedError

    def input_torque(self, at: Any, qd: Tensor, force: Tensor, prepared: Any) -> Tensor:
        """The tau, (..., n), that makes this force."""
        raise NotImplementedError

    def mass_matrix(self, q: Tensor, prepared: Any = None) -> Tensor:
        """M(q), (..., n, n)."""
        prepared = self.prepare() if prepared is None else prepared
        return self.mass_at(self.configuration(q, prepared), prepared)[0]

    def potential_energy(self, q: Tensor) -> Tensor:
        """V(q), (...) [J]."""
        prepared = self.prepare()
        return self.energy_at(self.configuration(q, prepared), prepared)

    def gravity(self, q: Tensor) -> Tensor:
        """dV/dq, (..., n) [Nm, N]."""
        prepared = self.prepare()
        return self.gravity_at(self.configuration(q, prepared), prepared)

    def nonlinear_effects(self, q: Tensor, qd: Tensor) -> Tensor:
        """Coriolis, centrifugal and gravity torque, (..., n) [Nm, N]."""
        prepared = self.prepare()
        at = self.configuration(q, prepared)
        return self.nonlinear_at(at, qd, self.mass_at(at, prepared)[1], prepared)

    def friction_torque(self, q: Tensor, qd: Tensor, z: Tensor | None = None) -> Tensor:
        """D(q, qd) qd, or the torque of bristles at z, (..., n) [Nm, N]."""
        prepared = self.prepare()
        return self.friction_at(self.configuration(q, prepared), qd, prepared, z)

    def dissipation(self, q: Tensor, qd: Tensor) -> Tensor:
        """D(q, qd), (..., n, n) [Nm s/rad, N s/m]."""
        prepared = self.prepare()
        return self.dissipation_at(self.configuration(q, prepared), qd, prepared)

    def input_matrix(self, q: Tensor) -> Tensor:
        """G(q), (..., n, n)."""
        prepared = self.prepare()
        return self.input_at(self.configuration(q, prepared), prepared)

    def hamiltonian(self, q: Tensor, p: Tensor, z: Tensor | None = None) -> Tensor:
        """H, (...) [J]."""
        prepared = self.prepare()
        at = self.configuration(q, prepared)
        qd = solved(self.mass_at(at, prepared)[0], p)
        energy = 0.5 * (p * qd).sum(dim=-1) + self.energy_at(at, prepared)
        return energy if z is None else energy + self.stored_energy(z, prepared)

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor, z: Tensor | None = None) -> Tensor:
        """qdd, (..., n), under the input tau."""
        prepared = self.prepare()
        at = self.configuration(q, prepared)
        mass, residuals = self.mass_at(at, prepared)
        force = self.input_force(at, qd, tau, prepared)
        force = force - self.nonlinear_at(at, qd, residuals, prepared)
        return solved(mass, force - self.friction_at(at, qd, prepared, z))

    def inverse_dynamics(self, q: Tensor, qd: Tensor, qdd: Tensor, z: Tensor | None = None) -> Tensor:
        """The torque, (..., n), that gives qdd."""
        prepared = self.prepare()
        at = self.configuration(q, prepared)
        mass, residuals = self.mass_at(at, prepared)
        force = applied(mass, qdd) + self.nonlinear_at(at, qd, residuals, prepared)
        return self.input_torque(at, qd, force + self.friction_at(at, qd, prepared, z), prepared)

    def port_hamiltonian_rhs(
        self, q: Tensor, p: Tensor, tau: Tensor | None, prepared: Any, z: Tensor | None = None
    ) -> State:
        """q' and p', (..., n), under the input tau; without one, of the arm left to itself."""
        at = self.configuration(q, prepared)
        mass, residuals = self.mass_at(at, prepared)
        qd = solved(mass, p)
        force = self.lagrangian_gradient(at, qd, residuals, prepared)
        force = force - self.friction_at(at, qd, prepared, z)
        return qd, force if tau is None else force + self.input_force(at, qd, tau, prepared)

    def state_rate(self, state: Tensor) -> Tensor:
        """The rate of (q, p, z), (..., 2 n + n K), or of (q, p, z, tau), where tau is held.

        A state that is too short for z has none: friction is then that of joints which slide.
        """
        n = self.n
        elements = self.elements if state.shape[-1] >= (2 + self.elements) * n else 0
        q, p, flat, tau = state.tensor_split((n, 2 * n, (2 + elements) * n), dim=-1)
        z = flat.reshape(*flat.shape[:-1], n, elements) if elements else None
        qd, force = self.port_hamiltonian_rhs(q, p, tau if tau.shape[-1] else None, self.prepare(), z)
        moved = flat if z is None else self.memory_rate(qd, z).flatten(-2)
        return torch.cat([qd, force, moved, torch.zeros_like(tau)], dim=-1)


def to_group(q: Tensor, joint_types: Sequence[str]) -> list[Tensor]:
    """By joint, R in SO(3), (..., 3, 3), or r in R^3, (..., 3), if prismatic; z is its axis."""
    parts = []
    for kind, value in zip(joint_types, q.unbind(dim=-1), strict=True):
        zero, one = torch.zeros_like(value), torch.ones_like(value)
        if kind == "revolute":
            c, s = value.cos(), value.sin()
            rows = ((c, -s, zero), (s, c, zero), (zero, zero, one))
            parts.append(torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2))
        else:
            parts.append(torch.stack((zero, zero, value), dim=-1))
    return parts


def from_group(parts: Sequence[Tensor], joint_types: Sequence[str]) -> Tensor:
    """q, (..., n), with angles in [-pi, pi]; the inverse of ``to_group``."""
    values = [
        torch.atan2(part[..., 1, 0], part[..., 0, 0]) if kind == "revolute" else part[..., 2]
        for kind, part in zip(joint_types, parts, strict=True)
    ]
    return torch.stack(values, dim=-1)


class Mass(Protocol):
    """What gives M(q) and its derivatives."""

    def prepare(self, definite: bool = True) -> Any:
        """All that depends on the weights alone; ``definite``: keep M positive definite."""

    def __call__(self, encoded: Tensor, prepared: Any) -> tuple[Tensor, Any]:
        """M(q), (..., n, n), and what its derivatives need."""

    def kinetic_vjp(self, encoded: Tensor, qd: Tensor, residuals: Any) -> Tensor:
        """The derivative of 1/2 qd^T M(q) qd by the encoding."""

    def jvp(self, rate: Tensor, residuals: Any) -> Tensor:
        """dM/dt, (..., n, n), where the encoding changes at this rate."""


class Friction(Protocol):
    """What gives D(q, qd)."""

    def prepare(self) -> Any:
        """All that depends on the weights alone."""

    def __call__(self, encoded: Tensor, qd: Tensor, prepared: Any) -> Tensor:
        """D qd, (..., n) [Nm, N]."""

    def dissipation(self, encoded: Tensor, qd: Tensor, prepared: Any) -> Tensor:
        """D, (..., n, n)."""


class Input(Protocol):
    """What gives G."""

    def prepare(self) -> Any:
        """All that depends on the weights alone."""

    def __call__(self, encoded: Tensor, prepared: Any) -> Tensor:
        """G, (..., n, n)."""

    def force(self, encoded: Tensor, tau: Tensor, prepared: Any) -> Tensor:
        """G tau, (..., n)."""

    def solve(self, encoded: Tensor, force: Tensor, prepared: Any) -> Tensor:
        """The inputs, (..., n), that make this force."""


class JointEncoding(nn.Module):
    """cos q, sin q and, where some joint is prismatic, the scaled q: (..., 2 n) or (..., 3 n)."""

    center: Tensor
    reach: Tensor

    def __init__(self, joints: Joints) -> None:
        super().__init__()
        self.prismatic = not all(joints.revolute)
        self.size = (3 if self.prismatic else 2) * joints.n
        self.register_buffer("center", vector(joints.center))
        self.register_buffer("reach", vector(joints.reach))

    def scaled(self, q: Tensor) -> Tensor:
        """q in units of a joint's reach about its center, (..., n)."""
        return (q - self.center) / self.reach

    def forward(self, q: Tensor) -> Tensor:
        """The encoding of q."""
        parts = [q.cos(), q.sin()]
        return torch.cat([*parts, self.scaled(q)] if self.prismatic else parts, dim=-1)

    def jvp(self, encoded: Tensor, qd: Tensor) -> Tensor:
        """How fast the encoding changes along qd."""
        cos, sin = encoded.chunk(3 if self.prismatic else 2, dim=-1)[:2]
        parts = [-sin * qd, cos * qd]
        return torch.cat([*parts, qd / self.reach] if self.prismatic else parts, dim=-1)

    def vjp(self, encoded: Tensor, cotangent: Tensor) -> Tensor:
        """d/dq, (..., n), of what has the derivative ``cotangent`` by the encoding."""
        parts = 3 if self.prismatic else 2
        cos, sin = encoded.chunk(parts, dim=-1)[:2]
        by_cos, by_sin, *by_scaled = cotangent.chunk(parts, dim=-1)
        by_joint = by_sin * cos - by_cos * sin
        return by_joint + by_scaled[0] / self.reach if self.prismatic else by_joint


class NetworkInput(NamedTuple):
    """The inputs of a network: sensitivity * (matrix @ encoded + offset), (..., inputs)."""

    joints: tuple[int, ...]  # of each input
    sensitivity: Tensor
    matrix: Tensor  # (inputs, encoded)
    offset: Tensor


def lie_group_input(joints: Joints, sensitivity: Sequence[float]) -> NetworkInput:
    """Of each joint the nine numbers of R in SO(3) or the three of r in R^3, times its sensitivity.

    z is the joint's axis, so R = [[cos q, -sin q, 0], [sin q, cos q, 0], [0, 0, 1]].
    """
    n = joints.n
    encoded = (2 if all(joints.revolute) else 3) * n
    owners: list[int] = []
    matrices, offsets = [], []
    for joint, revolute in enumerate(joints.revolute):
        size = 9 if revolute else 3
        matrix, offset = torch.zeros(size, encoded), torch.zeros(size)
        if revolute:
            matrix[[0, 4], joint], offset[8] = 1.0, 1.0
            matrix[1, n + joint], matrix[3, n + joint] = -1.0, 1.0
        else:
            matrix[2, 2 * n + joint] = 1.0
        owners += [joint] * size
        matrices.append(matrix)
        offsets.append(offset)
    weights = [sensitivity[joint] for joint in owners]
    return NetworkInput(
        tuple(owners), vector(weights), torch.cat(matrices).double(), torch.cat(offsets).double()
    )


def with_velocities(inputs: NetworkInput, joints: Joints, axes: int) -> NetworkInput:
    """These inputs, then each joint's velocity along so many axes, of which the last is the joint's own.

    The network then reads the encoding and, behind it, the velocities, (..., encoded + n).
    """
    n, (rows, encoded) = joints.n, inputs.matrix.shape
    matrix = torch.zeros(rows + axes * n, encoded + n, dtype=torch.float64)
    matrix[:rows, :encoded] = inputs.matrix
    matrix[rows + axes - 1 :: axes, encoded:] = torch.eye(n, dtype=torch.float64)
    velocities = torch.ones(axes * n, dtype=torch.float64)
    return NetworkInput(
        joints=(*inputs.joints, *(joint for joint in range(n) for _ in range(axes))),
        sensitivity=torch.cat([inputs.sensitivity, velocities]),
        matrix=matrix,
        offset=torch.cat([inputs.offset, 0 * velocities]),
    )


class DenseInput(nn.Module):
    """G(q) of a network, over all three axes of every joint, of which z moves."""

    moving: Tensor

    def __init__(self, joints: Joints, network: Network) -> None:
        super().__init__()
        self.register_buffer("moving", torch.eye(3 * joints.n).double()[2::3])
        self.network = network

    def prepare(self) -> Any:
        """The network's weights made ready for many states."""
        return self.network.prepare(self.moving, self.moving.sum(dim=1))

    def _gains(self, encoded: Tensor, prepared: Any) -> Tensor:
        return self.network(encoded, prepared)[0]

    def forward(self, encoded: Tensor, prepared: Any) -> Tensor:
        """G(q), (..., n, n), diagonal."""
        return torch.diag_embed(self._gains(encoded, prepared))

    def force(self, encoded: Tensor, tau: Tensor, prepared: Any) -> Tensor:
        """G(q) tau, (..., n)."""
        return self._gains(encoded, prepared) * tau

    def solve(self, encoded: Tensor, force: Tensor, prepared: Any) -> Tensor:
        """The inputs, (..., n), that make this force."""
        return force / self._gains(encoded, prepared)


FACTOR_START = 0.35  # diagonal of L, relative to the root of the joints' usual friction by speed


def lower_entries(rows: int) -> Tensor:
    """Spreads the numbers of a lower triangle, row by row, over a matrix: (rows, rows, numbers)."""
    row, column = torch.tril_indices(rows, rows)
    spread = torch.zeros(rows, rows, len(row), dtype=torch.float64)
    spread[row, column, torch.arange(len(row))] = 1.0
    return spread


class DenseFriction(nn.Module):
    """D(q, qd) = L L^T, with ``axes`` rows of L for each joint.

    A joint moves along the last of its axes alone, so only those rows of L are worked out.
    """

    speed: Tensor
    nominal: Tensor
    entries: Tensor
    start: Tensor

    def __init__(self, joints: Joints, network: Network, axes: int) -> None:
        super().__init__()
        rows = axes * joints.n
        self.register_buffer("speed", vector(joints.speed))
        self.register_buffer("nominal", vector(joints.friction))
        moving = slice(axes - 1, None, axes)
        self.register_buffer("entries", lower_entries(rows)[moving])
        self.register_buffer("start", FACTOR_START * torch.eye(rows).double()[moving])
        self.network = network

    def prepare(self) -> Any:
        """The network's weights made ready for many states."""
        size = torch.sqrt(self.nominal / self.speed).unsqueeze(-1)
        output_map = (size.unsqueeze(-1) * self.entries).flatten(0, 1)
        return self.network.prepare(output_map, (size * self.start).flatten())

    def _factor(self, encoded: Tensor, qd: Tensor, layers: Any) -> Tensor:
        rows: Tensor = self.network(torch.cat([encoded, qd / self.speed], dim=-1), layers)[0]
        return rows.reshape(*qd.shape[:-1], *self.start.shape)

    def forward(self, encoded: Tensor, qd: Tensor, layers: Any) -> Tensor:
        """The friction torque D qd, (..., n) [Nm, N]."""
        factor = self._factor(encoded, qd, layers)
        return (factor @ (factor.mT @ qd.unsqueeze(-1))).squeeze(-1)

    def dissipation(self, encoded: Tensor, qd: Tensor, layers: Any) -> Tensor:
        """D, (..., n, n)."""
        factor = self._factor(encoded, qd, layers)
        return factor @ factor.mT


class DenseResiduals(NamedTuple):
    """What M's derivatives need of the work done for M."""

    network: Any
    factor: Tensor  # U
    moved: Tensor  # U^-1 A, with A the moving columns of C^-1
    scale: Tensor  # e


def nominal_factor(joints: Joints, mean: Sequence[Sequence[float]]) -> Tensor:
    """C, lower triangular: C C^T is the nominal mean of M^-1 over all axes, (3 n, 3 n).

    ``mean`` is the lower triangle of the nominal mean of M without armature. z of each joint
    moves; about its other axes a joint is taken to be as heavy as about z.
    """
    n = joints.n
    mass = torch.zeros(n, n, dtype=torch.float64)
    row, column = torch.tril_indices(n, n)
    mass[row, column] = mass[column, row] = vector(x for entries in mean for x in entries)
    mass += torch.diag(vector(joints.armature))
    everywhere = torch.diag(mass.diagonal().repeat_interleave(3))
    everywhere[2::3, 2::3] = mass
    factor: Tensor = torch.linalg.cholesky(torch.linalg.inv(everywhere))
    return factor


class DenseMass(nn.Module):
    """M(q), (..., n, n), from M^-1 = C U diag(e) U^T C^T over all axes, (3 n, 3 n).

    C is the Cholesky factor of the nominal mean, U lower triangular with ones on its diagonal and
    e > 0, both given by a network: the Cholesky factorisation without square roots. The bearings
    hold all axes but z still, so M is the moving block of the inverse:
    (U^-1 A)^T diag(1 / e) U^-1 A, where A is the moving columns of C^-1.
    """

    nominal: Tensor
    moving: Tensor
    below: Tensor  # where the entries below U's diagonal stand in U, row by row
    start: Tensor

    def __init__(self, joints: Joints, mean: Sequence[Sequence[float]], network: Network) -> None:
        super().__init__()
        self.size = 3 * joints.n
        factor = nominal_factor(joints, mean)
        self.register_buffer("nominal", factor)
        self.register_buffer("moving", torch.linalg.inv(factor)[:, 2::3])
        row, column = torch.tril_indices(self.size, self.size, -1)
        self.register_buffer("below", row * self.size + column)
        # so that U starts without entries below its diagonal, and e at one
        start = vector([0.0] * len(row) + [math.log(math.e - 1)] * self.size)
        self.register_buffer("start", start)
        self.network = network

    def prepare(self, definite: bool = True) -> Any:
        """The network's weights made ready for many states."""
        return self.network.prepare(torch.diag(0 * self.start + 1), self.start)

    def inverse(self, encoded: Tensor, prepared: Any) -> Tensor:
        """M^-1 over all three axes of every joint, of which z moves; (..., 3 n, 3 n)."""
        factor, scale = self._factor(self.network(encoded, prepared)[0])
        lower = self.nominal @ (factor + torch.eye(self.size).to(factor))
        return (lower * scale.unsqueeze(-2)) @ lower.mT

    def _factor(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        """U, below its diagonal of ones, (..., 3 n, 3 n), and e, (..., 3 n)."""
        entries, scale = raw.tensor_split((len(self.below),), dim=-1)
        return self._lower(entries), F.softplus(scale)

    def _lower(self, entries: Tensor) -> Tensor:
        """The matrix, (..., 3 n, 3 n), with these entries below its diagonal, row by row."""
        rows = entries.new_zeros(*entries.shape[:-1], self.size * self.size)
        rows = rows.index_copy(-1, self.below, entries)
        return rows.reshape(*entries.shape[:-1], self.size, self.size)

    @staticmethod
    def _unit_solved(factor: Tensor, right: Tensor, upper: bool = False) -> Tensor:
        solution: Tensor = torch.linalg.solve_triangular(factor, right, upper=upper, unitriangular=True)
        return solution

    def forward(self, encoded: Tensor, prepared: Any) -> tuple[Tensor, DenseResiduals]:
        """M(q), and what its derivatives need."""
        raw, residuals = self.network(encoded, prepared)
        factor, scale = self._factor(raw)
        moved = self._unit_solved(factor, self.moving)
        mass = moved.mT @ (moved / scale.unsqueeze(-1))
        return mass, DenseResiduals(residuals, factor, moved, scale)

    def kinetic_vjp(self, encoded: Tensor, qd: Tensor, residuals: DenseResiduals) -> Tensor:
        """The derivative of 1/2 qd^T M(q) qd by the encoding."""
        _, factor, moved, scale = residuals
        speed = moved @ qd.unsqueeze(-1)
        momentum = speed / scale.unsqueeze(-1)
        by_factor = -self._unit_solved(factor.mT, momentum, upper=True) @ speed.mT
        by_entry = by_factor.flatten(-2).index_select(-1, self.below)
        by_scale = 0.5 * momentum.squeeze(-1) ** 2 * torch.expm1(-scale)
        cotangent = torch.cat([by_entry, by_scale], dim=-1)
        return self.network.vjp(residuals.network, cotangent)

    def jvp(self, rate: Tensor, residuals: DenseResiduals) -> Tensor:
        """dM/dt, (..., n, n), where the encoding changes at this rate."""
        _, factor, moved, scale = residuals
        pushed = self.network.jvp(residuals.network, rate)
        entries, raw_rate = pushed.tensor_split((len(self.below),), dim=-1)
        turned = self._unit_solved(factor, self._lower(entries) @ moved)
        by_factor = moved.mT @ (turned / scale.unsqueeze(-1))
        by_scale = raw_rate * torch.expm1(-scale) / scale**2
        return moved.mT @ (moved * by_scale.unsqueeze(-1)) - by_factor - by_factor.mT


class LearnedPotential(nn.Module):
    """V(q) [J], of one network, in units of ``scale``."""

    scale: Tensor

    def __init__(self, scale: float, network: Network) -> None:
        super().__init__()
        self.register_buffer("scale", torch.full((1, 1), scale, dtype=torch.float64))
        self.network = network

    def prepare(self) -> Any:
        """All that depends on the weights alone."""
        return self.network.prepare(self.scale, 0 * self.scale[0])

    def forward(self, encoded: Tensor, prepared: Any) -> Tensor:
        """V(q), (...) [J]."""
        energy: Tensor = self.network(encoded, prepared)[0].squeeze(-1)
        return energy

    def vjp(self, encoded: Tensor, prepared: Any) -> Tensor:
        """The derivative of V by the encoding."""
        _, residuals = self.network(encoded, prepared)
        return self.network.vjp(residuals, encoded.new_ones(1))


class MLPLayers(NamedTuple):
    """A network's weights made ready for many states; see ``MaskedMLP.prepare``."""

    weights: tuple[Tensor, ...]
    biases: tuple[Tensor, ...]


MLPResiduals = tuple[tuple[Tensor, ...], MLPLayers]


def sigmoid_vjp(cotangent: Tensor, value: Tensor) -> Tensor:
    """cotangent * value (1 - value), the sigmoid's derivative, in one pass over memory."""
    changed: Tensor = torch.ops.aten.sigmoid_backward(cotangent, value)
    return changed


class MaskedMLP(nn.Module):
    """A tanh network.

    ``layers`` names, unit by unit, the joints that each layer's units may read; weights between
    others are masked, so that a unit has no path to a joint it must not depend on.
    """

    matrix: Tensor
    offset: Tensor

    def __init__(
        self,
        inputs: NetworkInput,
        layers: Sequence[Sequence[frozenset[int]]],
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.register_buffer("matrix", inputs.matrix)
        self.register_buffer("offset", inputs.offset)
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        below = [frozenset((joint,)) for joint in inputs.joints]
        for index, units in enumerate(layers):
            allowed = [[float(lower <= upper) for lower in below] for upper in units]
            mask = torch.tensor(allowed, dtype=torch.float64)
            weight = torch.randn(mask.shape, dtype=torch.float64, generator=generator)
            self.weights.append(nn.Parameter(weight / mask.sum(dim=1, keepdim=True).sqrt()))
            mask = mask * inputs.sensitivity if index == 0 else mask
            self.register_buffer(f"mask{index}", mask)
            self.biases.append(nn.Parameter(torch.zeros(len(units), dtype=torch.float64)))
            below = list(units)
        nn.init.zeros_(self.weights[-1])  # so that nothing is learned yet

    def prepare(self, output_map: Tensor, offset: Tensor) -> MLPLayers:
        """The weights for the encoding as it is, and for offset + output_map y in place of y.

        tanh x is computed as 2 sigmoid(2 x) - 1, which takes a fraction of the time.
        """
        weights, biases = [], []
        for index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            weight = weight * self.get_buffer(f"mask{index}")
            if index == 0:
                bias, weight = bias + weight @ self.offset, weight @ self.matrix
            else:
                bias, weight = bias - weight.sum(dim=1), 2 * weight
            weights.append(2 * weight)
            biases.append(2 * bias)
        weights[-1] = 0.5 * output_map @ weights[-1]
        biases[-1] = offset + 0.5 * output_map @ biases[-1]
        return MLPLayers(tuple(weights), tuple(biases))

    def forward(self, encoded: Tensor, layers: MLPLayers) -> tuple[Tensor, MLPResiduals]:
        """offset + output_map y, (..., rows); and what ``vjp`` and ``jvp`` need."""
        layer, hidden = encoded, []
        for weight, bias in zip(layers.weights[:-1], layers.biases, strict=False):
            layer = torch.sigmoid(F.linear(layer, weight, bias))
            hidden.append(layer)
        return F.linear(layer, layers.weights[-1], layers.biases[-1]), (tuple(hidden), layers)

    def vjp(self, residuals: MLPResiduals, cotangent: Tensor) -> Tensor:
        """The reverse sweep: cotangent, (..., rows), times d/d encoded; (..., encoded)."""
        hidden, layers = residuals
        layer = cotangent @ layers.weights[-1]
        for weight, value in zip(reversed(layers.weights[:-1]), reversed(hidden), strict=True):
            layer = sigmoid_vjp(layer, value) @ weight
        return layer

    def jvp(self, residuals: MLPResiduals, tangent: Tensor) -> Tensor:
        """The forward sweep: d/d encoded times the encoding's tangent; (..., rows)."""
        hidden, layers = residuals
        for weight, value in zip(layers.weights[:-1], hidden, strict=True):
            tangent = sigmoid_vjp(F.linear(tangent, weight), value)
        return F.linear(tangent, layers.weights[-1])


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
        self.n, self.elements = len(encoding.center), 0
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
