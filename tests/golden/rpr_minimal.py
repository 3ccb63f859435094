r"""Port-Hamiltonian model of an arm with 3 joints, written by `spelgen build`.

3 learned functions of q and 2 constants make the mass matrix.
The potential energy depends on joint 3.
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

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor, nn

FACTS = r"""{"robot": "rpr", "urdf": "rpr.urdf",
 "urdf_sha256": "aaacb65e5fa6a4caf626114ddf8869514f479b568dae43957e41214d3c6eff8d",
 "spec_sha256": "78e16dc7ad67f88500d19ab13a555f327d630ef495be053e71cb4ca2d0ce6f84",
 "options": {"angle_tolerance": 0.002, "assume": "kinematics", "depth": 2, "design": null, "joints": null,
  "net": "mlp", "preset": "minimal", "tip": null, "width": 64},
 "joints": {"joint1": "revolute", "joint2": "prismatic", "joint3": "revolute"}}"""


class Model(nn.Module):
    """The arm's dynamics: 3 learned functions of q and 2 constants make the mass matrix.

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
        functions = (
            MassFunction((2,), mean=-0.00167665, scale=1.36528),
            MassFunction((1, 2), mean=-0.00154309, scale=0.0595527),
            MassFunction((1, 2), mean=139.887, scale=12.6351),
        )  # fmt: skip
        constants = ((0.0101411, 0.0101411), (5.33, 5.33))
        network = MaskedMLP(
            joint_input(joints, (1, 2), (0.02, 1.0, 0.518)),
            unit_joints([function.joints for function in functions], width=64, depth=2, least=4), generator,
        )  # fmt: skip
        mass = DerivedMass(joints, self.mass_entries, functions, constants, network, 0.08)
        network = MaskedMLP(
            joint_input(joints, (2,), (0.02, 0.02, 1.0)), unit_joints(((2,),), width=32, depth=2), generator
        )
        potential = LearnedPotential(0.703291, network)
        friction = JointFriction(joints, encoding, generator)
        self.dynamics = NetworkDynamics(encoding, mass, potential, friction, DirectInput(joints))
        self.to(dtype)

    @staticmethod
    def mass_entries(f: Sequence[Tensor], c: Sequence[Tensor]) -> Tensor:
        """M without armature, (..., n, n), by its functions f(q) and its constants c."""
        # f1(q3), f2(q2,3), f3(q2,3)
        f1, f2, f3 = f
        c1, c2 = c
        return symmetric([f3], [f1, c2], [f2, 0, c1])

    @property
    def armature(self) -> Tensor:
        """What the drives add to M's diagonal, (n,) [kg m^2, kg]."""
        value: Tensor = self.dynamics.mass.armature.forward()
        return value

    @property
    def rotor_inertia(self) -> Tensor:
        """The drives' inertia before the gear, (n,) [kg m^2, kg]."""
        value: Tensor = self.dynamics.mass.armature.rotor_inertia()
        return value

    @property
    def viscous(self) -> Tensor:
        """Friction torque by velocity, (n,) [Nm s/rad, N s/m]."""
        value: Tensor = self.dynamics.friction.viscous()
        return value

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


Entries = Callable[[Sequence[Tensor], Sequence[Tensor]], Tensor]


def symmetric(*rows: Sequence[Tensor | float]) -> Tensor:
    """The matrix, (..., n, n), with these rows as its lower triangle; entries are (...) or numbers."""
    some = next(entry for row in rows for entry in row if isinstance(entry, Tensor))
    lower = [[entry if isinstance(entry, Tensor) else some * 0 + entry for entry in row] for row in rows]
    n = len(lower)
    whole = [[lower[max(i, j)][min(i, j)] for j in range(n)] for i in range(n)]
    return torch.stack([torch.stack(row, dim=-1) for row in whole], dim=-2)


def entry_basis(entries: Entries, functions: int, constants: int) -> tuple[Tensor, Tensor]:
    """What each function and each constant adds to a matrix that is linear in them, as rows.

    (functions, n n) and (constants, n n); found by asking ``entries`` for one at a time.
    """
    f, c = torch.eye(functions).double(), torch.eye(constants).double()
    by_function = entries(f.unbind(), f.new_zeros(constants, functions).unbind())
    by_constant = entries(c.new_zeros(functions, constants).unbind(), c.unbind())
    return by_function.flatten(1), by_constant.flatten(1)


class PositiveDefiniteBound(nn.Module):
    """Draws M towards a positive definite matrix C, as far as M needs it to be positive definite.

    M' = C + t (M - C), with t = 1 wherever M - margin C is positive definite. Elsewhere t = 2^-k is
    the first such power with t |M - C| <= 1 - margin, |.| being at least the norm relative to C:
    then M' - margin C is positive definite. t is constant in pieces, so that derivatives of M' are
    t times those of M. C has M's own zeros and linear relations, which therefore hold in M'.
    """

    center: Tensor  # C
    least: Tensor  # margin C
    unit: Tensor  # an entry's largest part in the norm relative to C, divided by 1 - margin

    def __init__(self, center: Tensor, margin: float) -> None:
        super().__init__()
        scale = center.diagonal().rsqrt()
        scaled = scale.unsqueeze(-1) * center * scale
        least = torch.linalg.eigvalsh(scaled)[0]
        self.register_buffer("center", center)
        self.register_buffer("least", margin * center)
        self.register_buffer("unit", scale.unsqueeze(-1) * scale / least / (1 - margin))

    def forward(self, mass: Tensor) -> tuple[Tensor, Tensor]:
        """M', (..., n, n), and t, (...)."""
        fixed = mass.detach()
        indefinite = torch.linalg.cholesky_ex(fixed - self.least).info != 0
        size = torch.linalg.vector_norm(self.unit * (fixed - self.center), dim=(-2, -1))
        part = torch.where(indefinite, torch.exp2(-torch.ceil(torch.log2(size)).clamp(min=1.0)), 1.0)
        return torch.lerp(self.center, mass, part[..., None, None]), part


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


class Armature(nn.Module):
    """Rotor inertia times gear squared of each joint, never negative; the weights are logarithms."""

    nominal: Tensor
    gear: Tensor

    def __init__(self, joints: Joints) -> None:
        super().__init__()
        self.register_buffer("nominal", vector(joints.armature))
        self.register_buffer("gear", vector(joints.gear))
        self.raw = nn.Parameter(torch.zeros(joints.n, dtype=torch.float64))

    def forward(self) -> Tensor:
        """The diagonal of the drives' part of M, (n,) [kg m^2, kg]."""
        return self.nominal * self.raw.exp()

    def rotor_inertia(self) -> Tensor:
        """As the motors feel it, before the gear, (n,) [kg m^2, kg]."""
        return self.nominal * self.raw.exp() / self.gear**2


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


def joint_input(joints: Joints, chosen: Iterable[int], sensitivity: Sequence[float]) -> NetworkInput:
    """cos q and sin q of revolute joints, the scaled q of prismatic ones, times a joint's sensitivity."""
    n, encoded = joints.n, (2 if all(joints.revolute) else 3) * joints.n
    chosen = list(chosen)
    turning = [joint for joint in chosen if joints.revolute[joint]]
    sliding = [joint for joint in chosen if not joints.revolute[joint]]
    owners = (*turning, *turning, *sliding)
    places = [*turning, *(n + joint for joint in turning), *(2 * n + joint for joint in sliding)]
    matrix = torch.eye(encoded, dtype=torch.float64)[places]
    return NetworkInput(owners, vector(sensitivity[j] for j in owners), matrix, 0 * matrix.sum(dim=1))


def motor_speeds(gains: Tensor) -> Tensor:
    """C, (n, n): the motors' speeds are C qd, where the joints' torques are ``gains`` times the motors'.

    By the same power, each motor's in the units of the joint that it moves most: C is the identity where
    each moves its own joint alone.
    """
    largest = gains.gather(0, gains.abs().argmax(dim=0, keepdim=True))
    passive = largest == 0
    return (gains / torch.where(passive, torch.ones_like(largest), largest)).mT + torch.diag(
        passive[0].to(gains)
    )


class DirectInput(nn.Module):
    """G is the identity: each input is the torque of its own joint, and none that of a passive one.

    motor_speeds: C, (n, n), where motors move several joints all the same: they turn by C qd.
    """

    actuated: Tensor

    def __init__(self, joints: Joints, motor_speeds: Sequence[Sequence[float]] = ()) -> None:
        super().__init__()
        self.register_buffer("actuated", vector(float(x) for x in joints.actuated))
        self._motor_speeds = motor_speeds

    def motor_speeds(self) -> Tensor:
        """C, (n, n), by joint velocities."""
        if not self._motor_speeds:
            return torch.eye(len(self.actuated), dtype=torch.float64)
        return torch.tensor(self._motor_speeds, dtype=torch.float64)

    def prepare(self) -> Tensor:
        """The diagonal of G, (n,)."""
        return self.actuated

    def forward(self, encoded: Tensor, prepared: Tensor) -> Tensor:
        """G, (..., n, n)."""
        return torch.diag(prepared).expand(*encoded.shape[:-1], len(prepared), len(prepared))

    def force(self, encoded: Tensor, tau: Tensor, prepared: Tensor) -> Tensor:
        """G tau, (..., n)."""
        return prepared * tau

    def solve(self, encoded: Tensor, force: Tensor, prepared: Tensor) -> Tensor:
        """The inputs, (..., n), that make this force; a passive joint shows the torque it lacks."""
        return force


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


class MassFunction(NamedTuple):
    """A learned function f of some joints: mean + scale * network."""

    joints: tuple[int, ...]
    mean: float  # over the workspace, with nominal inertias
    scale: float


class MassPrepared(NamedTuple):
    """What depends on the weights alone."""

    layers: Any  # of the network
    definite: bool  # whether M is kept positive definite


class MassResiduals(NamedTuple):
    """What M's derivatives need of the work done for M."""

    network: Any
    part: Tensor  # of the functions' changes that M takes, see PositiveDefiniteBound


class DerivedMass(nn.Module):
    """M(q), (..., n, n), with ``entries`` saying where functions and constants stand.

    A constant starts at the first of its two numbers, and is trained in units of the second. Where
    M would not exceed margin * its nominal mean, it is drawn towards that mean (see
    PositiveDefiniteBound): M is positive definite for all q and all weights.
    """

    constant_scale: Tensor
    constant_basis: Tensor  # (constants, n n)
    function_mean: Tensor
    function_scale: Tensor
    function_basis: Tensor  # (functions, n n)

    def __init__(
        self,
        joints: Joints,
        entries: Entries,
        functions: Sequence[MassFunction],
        constants: Sequence[tuple[float, float]],
        network: Network,
        margin: float,
    ) -> None:
        super().__init__()
        self.n = joints.n
        start = vector(first for first, _ in constants)
        by_function, by_constant = entry_basis(entries, len(functions), len(constants))
        self.register_buffer("constant_scale", vector(unit for _, unit in constants))
        self.register_buffer("constant_basis", by_constant)
        self.register_buffer("function_mean", vector(each.mean for each in functions))
        self.register_buffer("function_scale", vector(each.scale for each in functions))
        self.register_buffer("function_basis", by_function)
        mean = start @ self.constant_basis + self.function_mean @ self.function_basis
        self.bound = PositiveDefiniteBound(self._square(mean), margin)
        self.raw_constants = nn.Parameter(start / self.constant_scale)
        self.network = network
        self.armature = Armature(joints)

    def constants(self) -> Tensor:
        """The constants of M, (constants,), in their units."""
        return self.constant_scale * self.raw_constants

    def prepare(self, definite: bool = True) -> MassPrepared:
        """All that depends on the weights alone; ``definite``: keep M positive definite."""
        armature = torch.diag(self.armature())
        constant = self.constants() @ self.constant_basis
        constant = constant + self.function_mean @ self.function_basis + armature.flatten()
        output_map = (self.function_scale.unsqueeze(-1) * self.function_basis).mT
        return MassPrepared(self.network.prepare(output_map, constant), definite)

    def _square(self, rows: Tensor) -> Tensor:
        """(..., n n) as (..., n, n)."""
        return rows.reshape(*rows.shape[:-1], self.n, self.n)

    def forward(self, encoded: Tensor, prepared: MassPrepared) -> tuple[Tensor, MassResiduals]:
        """M(q), and what its derivatives need."""
        rows, residuals = self.network(encoded, prepared.layers)
        mass = self._square(rows)
        part = torch.ones_like(mass[..., 0, 0])
        if prepared.definite:
            mass, part = self.bound(mass)
        return mass, MassResiduals(residuals, part)

    def kinetic_vjp(self, encoded: Tensor, qd: Tensor, residuals: MassResiduals) -> Tensor:
        """The derivative of 1/2 qd^T M(q) qd by the encoding."""
        half = 0.5 * residuals.part.unsqueeze(-1) * qd
        weight = (half.unsqueeze(-1) * qd.unsqueeze(-2)).flatten(-2)
        return self.network.vjp(residuals.network, weight)

    def jvp(self, rate: Tensor, residuals: MassResiduals) -> Tensor:
        """dM/dt, (..., n, n), where the encoding changes at this rate."""
        rows = self.network.jvp(residuals.network, rate)
        return residuals.part[..., None, None] * self._square(rows)


HIDDEN = 8  # units of a joint's network


POSITION_SENSITIVITY = 0.1  # of friction's networks, relative to velocity


SMOOTHING = 0.03  # below this fraction of its usual speed dry friction fades to zero, to start from


LEAST_SMOOTHING = 0.001  # and at the least


class FrictionLayers(NamedTuple):
    """The weights made ready for many states, all joints' networks in one."""

    weight: Tensor
    bias: Tensor
    out: Tensor
    offset: Tensor
    viscous: Tensor  # [Nm s/rad, N s/m]
    smoothing: Tensor  # coulomb smoothing velocity squared [rad^2/s^2, m^2/s^2]


class JointFriction(nn.Module):
    """A diagonal D(q, qd), positive for all weights."""

    matrix: Tensor  # where the inputs of a joint's network stand, (joints, inputs, encoded + 2 n)
    speed: Tensor
    nominal: Tensor

    def __init__(self, joints: Joints, encoding: JointEncoding, generator: torch.Generator) -> None:
        super().__init__()
        n, inputs = joints.n, 4
        matrix = torch.zeros(n, inputs, encoding.size + 2 * n, dtype=torch.float64)
        for i, revolute in enumerate(joints.revolute):
            cos, sin = (i, n + i) if revolute else (2 * n + i, 2 * n + i)
            matrix[i, 0, cos] = matrix[i, 1, sin] = POSITION_SENSITIVITY
            matrix[i, 2, i - 2 * n], matrix[i, 3, i - n] = 1 / joints.speed[i], 1.0
        self.register_buffer("matrix", matrix)
        self.register_buffer("speed", vector(joints.speed))
        self.register_buffer("nominal", vector(joints.friction))
        self.raw_smoothing = nn.Parameter(torch.zeros(n, dtype=torch.float64))
        self.raw_viscous = nn.Parameter(torch.full((n,), -2.0, dtype=torch.float64))
        shape = (n, inputs, HIDDEN)
        weight = torch.randn(shape, dtype=torch.float64, generator=generator)
        self.weight = nn.Parameter(weight / inputs**0.5)
        self.bias = nn.Parameter(torch.zeros(n, HIDDEN, dtype=torch.float64))
        self.out = nn.Parameter(torch.zeros(n, HIDDEN, dtype=torch.float64))
        self.offset = nn.Parameter(torch.full((n,), -2.0, dtype=torch.float64))

    def viscous(self) -> Tensor:
        """Torque per velocity, (n,) [Nm s/rad, N s/m]."""
        return self.nominal * F.softplus(self.raw_viscous) / self.speed

    def coulomb_smoothing_velocity(self) -> Tensor:
        """Where dry friction has turned around, (n,) [rad/s, m/s]."""
        return self.speed * (LEAST_SMOOTHING**2 + (SMOOTHING * self.raw_smoothing.exp()) ** 2).sqrt()

    def prepare(self) -> FrictionLayers:
        """All joints' networks as one: block matrices are faster than a loop over joints.

        Their tanh x is computed as 2 sigmoid(2 x) - 1, which takes a fraction of the time.
        """
        own = torch.eye(self.out.shape[0], dtype=self.out.dtype, device=self.out.device)
        return FrictionLayers(
            weight=2 * (self.weight.mT @ self.matrix).flatten(0, 1),
            bias=2 * self.bias.flatten(),
            out=2 * (own.unsqueeze(-1) * self.out).flatten(1),
            offset=self.offset - self.out.sum(dim=1),
            viscous=self.viscous(),
            smoothing=self.coulomb_smoothing_velocity() ** 2,
        )

    def _dry(self, encoded: Tensor, qd: Tensor, direction: Tensor, layers: FrictionLayers) -> Tensor:
        """Dry friction relative to its usual size, (..., n)."""
        inputs = torch.cat([encoded, qd, direction], dim=-1)
        hidden = torch.sigmoid(F.linear(inputs, layers.weight, layers.bias))
        return F.softplus(F.linear(hidden, layers.out, layers.offset))

    def forward(self, encoded: Tensor, qd: Tensor, layers: FrictionLayers) -> Tensor:
        """The friction torque D qd, (..., n) [Nm, N]."""
        direction = qd * torch.rsqrt(qd * qd + layers.smoothing)  # -1 or 1, smooth at standstill
        dry = self._dry(encoded, qd, direction, layers)
        return layers.viscous * qd + self.nominal * direction * dry

    def dissipation(self, encoded: Tensor, qd: Tensor, layers: FrictionLayers) -> Tensor:
        """D, (..., n, n) [Nm s/rad, N s/m], diagonal."""
        smooth_speed = torch.sqrt(qd * qd + layers.smoothing)
        dry = self._dry(encoded, qd, qd / smooth_speed, layers)
        return torch.diag_embed(layers.viscous + self.nominal * dry / smooth_speed)


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
