r"""Port-Hamiltonian model of an arm with 3 joints, written by `spelgen build`.

3 rigid bodies with trained inertial parameters;
networks for what they leave: 3 learned functions of q and 2 constants in M.
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

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor, nn

FACTS = r"""{"robot": "rpr", "urdf": "rpr.urdf",
 "urdf_sha256": "aaacb65e5fa6a4caf626114ddf8869514f479b568dae43957e41214d3c6eff8d",
 "spec_sha256": "765da56814f8b95376bd87633bc5dfaec8f5161fa9db5448b6d7d871c48b3080",
 "options": {"angle_tolerance": 0.002, "assume": "kinematics", "depth": 2, "design": null, "joints": null,
  "net": "mlp", "preset": "hybrid", "tip": null, "width": 64},
 "joints": {"joint1": "revolute", "joint2": "prismatic", "joint3": "revolute"}}"""


class Model(nn.Module):
    """The arm's dynamics: 3 rigid bodies with trained inertial parameters, and networks for what they leave.

    q, qd, qdd, tau and p are (..., n), with any leading dimensions; rad and Nm, m and N if prismatic. For all
    weights M is positive definite, D positive semi-definite. ``prepared``: what ``prepare`` gave, for speed.
    z, (..., n, 4), friction's memory, is how far its bristles are bent [rad, m]; None: they slide as qd goes.
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
        bodies = Bodies(
            parent=(-1, 0, 1), joint=(0, 1, 2), revolute=(True, False, True), ratio=(1.0, 1.0, 1.0),
            offset=(0.0, 0.0, 0.0),
            rotation=(
                ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
                ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
                ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
            ),
            position=((0.0, 0.0, 0.0), (0.0, 0.0, 0.154), (0.0, -0.0203, 0.0)), mass=(5.01, 4.25, 1.08),
            moment=((0.0, 0.0, -4.48896), (0.0, -0.086275, -27.4125), (0.0, 0.09936, -0.05832)),
            inertia=(
                (4.13010816, 4.12210816, 0.018), (179.3223764, 179.320625, 0.0077513825),
                (0.0142904, 0.00425851, 0.0102504),
            ),
            products=((0.0, 0.0, 0.0), (0.0, 0.0, -0.55647375), (0.0, 0.0, 0.00536544)),
        )  # fmt: skip
        generator = torch.Generator().manual_seed(seed)
        functions = ((2,),) + ((1, 2),) * 2
        network = MaskedMLP(
            joint_input(joints, (1, 2), (0.02, 1.0, 0.518)),
            unit_joints(functions, width=64, depth=2, least=4), generator,
        )  # fmt: skip
        mass = ResidualMass(joints, self.mass_entries, 3, 2, network)
        network = MaskedMLP(
            joint_input(joints, (2,), (0.02, 0.02, 1.0)), unit_joints(((2,),), width=32, depth=2), generator
        )
        potential = LearnedPotential(0.703291, network)
        self.dynamics = ResidualDynamics(
            joints, bodies, (0.0, 0.0, -9.81), DirectInput(joints), mass, potential,
            reach=((0.0001, 0.001, 0.01, 0.1), (1e-05, 0.0001, 0.001, 0.01), (0.0001, 0.001, 0.01, 0.1)),
        )  # fmt: skip
        self.to(dtype)

    @staticmethod
    def mass_entries(f: Sequence[Tensor], c: Sequence[Tensor]) -> Tensor:
        """R, what M has beside rigid bodies, (..., n, n), by its functions f(q) and its constants c."""
        # f1(q3), f2(q2,3), f3(q2,3)
        f1, f2, f3 = f
        c1, c2 = c
        return symmetric([f3], [f1, c2], [f2, 0, c1])

    @property
    def inertial_parameters(self) -> Tensor:
        """By body (m, m c, Ixx, Ixy, Ixz, Iyy, Iyz, Izz) about its joint's frame, (bodies, 10)."""
        return self.dynamics.inertial_parameters.forward()

    @property
    def armature(self) -> Tensor:
        """What the drives add to M's diagonal, (n,) [kg m^2, kg]."""
        return self.dynamics.armature.forward()

    @property
    def rotor_inertia(self) -> Tensor:
        """The drives' inertia before the gear, (n,) [kg m^2, kg]."""
        return self.dynamics.armature.rotor_inertia()

    @property
    def viscous(self) -> Tensor:
        """Friction torque by velocity, (n,) [Nm s/rad, N s/m]."""
        return self.dynamics.friction.prepare().viscous

    @property
    def coulomb(self) -> Tensor:
        """Dry friction, (n,) [Nm, N]."""
        return self.dynamics.friction.prepare().coulomb

    @property
    def torque_offset(self) -> Tensor:
        """What the measured torque shows without any, (n,) [Nm, N]."""
        return self.dynamics.torque_offset()

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


def blocks(rows: Tensor, *shape: int) -> Tensor:
    """(..., m) as (..., m / size, *shape), size the product of the shape."""
    return rows.reshape(*rows.shape[:-1], rows.shape[-1] // math.prod(shape), *shape)


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


def combined(weights: Tensor, rows: Tensor) -> Tensor:
    """The sum of weighted rows, weights^T rows, (..., m)."""
    if weights.dim() == 1:
        return weights @ rows
    return (weights.unsqueeze(-2) @ rows).squeeze(-2)


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


class Bristles(nn.Module):
    """K elements a joint, elastic up to their reach, sliding beyond; z is (..., n, K) [rad, m].

    z' = qd - |qd| z / reach, whatever the speed: in displacement it is linear, and needs no small
    steps (Dahl, A Solid Friction Model, 1968; several elements as in Lampaert, Al-Bender and
    Swevers, A Generalized Maxwell-Slip Friction Model, 2003).
    """

    reach: Tensor  # (n, K)

    def __init__(self, reach: Sequence[Sequence[float]]) -> None:
        super().__init__()
        self.register_buffer("reach", torch.tensor(reach, dtype=torch.float64))

    def rate(self, qd: Tensor, z: Tensor) -> Tensor:
        """z', (..., n, K)."""
        return qd.unsqueeze(-1) - qd.abs().unsqueeze(-1) * z / self.reach

    def moved(self, z: Tensor, displacement: Tensor) -> Tensor:
        """z after joints went one way by (..., n), exactly."""
        return moved_bristles(z, displacement, self.reach)


def moved_bristles(z: Tensor, displacement: Tensor, reach: Tensor) -> Tensor:
    """z, (..., n, K), after joints went one way by (..., n), exactly."""
    end = displacement.sign().unsqueeze(-1) * reach
    return end + (z - end) * (-displacement.abs().unsqueeze(-1) / reach).exp()


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


class DriveInput(Input, Protocol):
    """What gives a constant G, and how the drives turn."""

    def motor_speeds(self) -> Tensor:
        """C, (n, n): the drives' speeds are C qd."""


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


SPLINES = 34  # over the range of a joint


HARMONICS = 64  # of a turn of the joint, and the first two of a turn of the motor: teeth and poles come again


FINE = 5  # sines are dear: the k-th harmonic is made of the |b|-th, b from -FINE to FINE,


COARSE = 6  # and of the (2 FINE + 1) a-th, a up to COARSE, where k = (2 FINE + 1) a + b


LARGEST = math.log(10.0)  # logarithm of friction's factor: it stays between a tenth and ten times


class JointFunctionWeights(NamedTuple):
    """What depends on the weights alone."""

    splines: Tensor  # of the torque [Nm, N] and of friction, by cubes, (n, SPLINES, 2)
    ripple: Tensor  # of products of fine and coarse waves [Nm], (n, 2 FINE + 2, 2 COARSE + 6)


def ripple_frequencies(joints: Joints) -> Tensor:
    """How often in a turn of the joint a ripple may come again, (n, HARMONICS + 2)."""
    few = tuple(range(1, HARMONICS + 3))
    rows = [(*few[:-2], gear, 2 * gear) if gear > HARMONICS else few for gear in joints.gear]
    return torch.tensor(rows, dtype=torch.float64)


def _products(cosines: Tensor, sines: Tensor) -> Tensor:
    """By which products of fine and coarse waves harmonics are made, (n, 2 FINE + 2, 2 COARSE + 6)."""
    pads = FINE + 1, (2 * FINE + 1) * COARSE + FINE - HARMONICS
    above, below, own = [], [], []
    for harmonics in (cosines, sines):
        regular, few = harmonics.tensor_split((HARMONICS,), dim=1)
        rows = F.pad(regular, pads).reshape(-1, COARSE + 1, 2 * FINE + 1).mT  # (n, b + FINE, a)
        above.append(rows[:, FINE:])
        below.append(F.pad(rows[:, :FINE].flip(1), (0, 0, 1, 0)))
        own.append(F.pad(few.unsqueeze(1), (0, 0, 0, FINE)))
    by_cos = above[0] + below[0], own[0], above[1] + below[1], own[1]
    by_sin = above[1] - below[1], 0 * own[0], below[0] - above[0], 0 * own[1]
    return torch.cat([torch.cat(by_cos, dim=2), torch.cat(by_sin, dim=2)], dim=1)


def _by_joint(rows: Tensor, matrices: Tensor) -> Tensor:
    """Each joint's row, (..., n, k), times its own matrix, (n, k, m)."""
    if rows.dim() == 2:  # fewer steps, which is what one state costs
        return (rows.unsqueeze(-2) @ matrices).squeeze(-2)
    return torch.einsum("...ik,ikm->...im", rows, matrices)


class JointFunctions(nn.Module):
    """By joint a torque t(q) = dV/dq, its energy V(q), and a factor on friction, from q of that joint alone.

    t is a sum of cubic B-splines over the joint's range and, of a revolute joint, of harmonics of its
    turns and of its motor's; the factor is the exponential of such a spline, between a tenth and ten for
    all weights. Splines vanish where the range ends, so that nothing is added where nothing was seen.
    Weights are zero at first; torques are in units of usual friction.
    """

    scale: Tensor
    spacing: Tensor
    middles: Tensor
    revolute: Tensor
    frequencies: Tensor
    waves: Tensor  # how often fine ones, then coarse ones and the motor's, come again in a turn
    quarter: Tensor  # by how much cosines are ahead of sines

    def __init__(self, joints: Joints) -> None:
        super().__init__()
        n = joints.n
        self.prismatic = not all(joints.revolute)
        spacing = 2 * vector(joints.reach).unsqueeze(-1) / (SPLINES - 3)
        knots = torch.arange(SPLINES).double() - (SPLINES - 1) / 2
        self.register_buffer("scale", vector(joints.friction))
        self.register_buffer("spacing", spacing)
        self.register_buffer("middles", vector(joints.center).unsqueeze(-1) + spacing * knots)
        self.register_buffer("revolute", vector(float(each) for each in joints.revolute).unsqueeze(-1))
        frequencies = ripple_frequencies(joints)
        fine, coarse = torch.arange(FINE + 1.0), (2 * FINE + 1) * torch.arange(COARSE + 1.0)
        fine, coarse = fine.double().expand(n, -1), coarse.double().expand(n, -1)
        coarse = torch.cat([coarse, frequencies[:, HARMONICS:]], dim=1)
        self.register_buffer("frequencies", frequencies)
        self.register_buffer("waves", torch.cat([fine, fine, coarse, coarse], dim=1))
        ahead = [torch.full_like(half[0], x) for half in (fine, coarse) for x in (math.pi / 2, 0.0)]
        self.register_buffer("quarter", torch.cat(ahead))
        self.raw_torque_splines = nn.Parameter(torch.zeros(n, SPLINES, dtype=torch.float64))
        self.raw_torque_ripple = nn.Parameter(torch.zeros(n, 2 * (HARMONICS + 2), dtype=torch.float64))
        self.raw_friction_splines = nn.Parameter(torch.zeros(n, SPLINES, dtype=torch.float64))

    def prepare(self) -> JointFunctionWeights:
        """All that depends on the weights alone."""
        scale = self.scale.unsqueeze(-1)
        splines = torch.stack([scale * self.raw_torque_splines, self.friction_logarithms()], dim=-1) / 6
        cosines, sines = (scale * self.revolute * self.raw_torque_ripple).chunk(2, dim=1)
        return JointFunctionWeights(splines, _products(cosines, sines))

    def forward(self, q: Tensor, weights: JointFunctionWeights) -> tuple[Tensor, Tensor]:
        """dV/dq [Nm, N], and how much more friction there is than elsewhere, positive; (..., n) both."""
        smooth, friction = _by_joint(self._cubes(q), weights.splines).unbind(-1)
        waves = torch.addcmul(self.quarter, q.unsqueeze(-1), self.waves).sin()
        fine, coarse = waves.tensor_split((2 * FINE + 2,), dim=-1)
        ripple = (_by_joint(fine, weights.ripple) * coarse).sum(dim=-1)
        return smooth + ripple, friction.exp()

    def friction_logarithms(self) -> Tensor:
        """Weights of the splines whose sum is the logarithm of friction's factor, (n, SPLINES)."""
        return LARGEST * (self.raw_friction_splines / LARGEST).tanh()

    def splines(self, q: Tensor) -> Tensor:
        """The cubic B-splines at q, (..., n, SPLINES), each 2/3 high."""
        return self._cubes(q) / 6

    def ripple(self, q: Tensor) -> Tensor:
        """Cosines, then sines of frequency times q, (..., n, 2 HARMONICS + 4); zero for a prismatic joint."""
        phase = q.unsqueeze(-1) * self.frequencies
        both = torch.cat([phase.cos(), phase.sin()], dim=-1)
        return both * self.revolute if self.prismatic else both

    def energy(self, q: Tensor) -> Tensor:
        """V, (...) [J]; of what ends where the range does, half on either side."""
        place = self._places(q)
        away = place.abs()
        part = 0.5 - (2 - away).relu() ** 4 / 24 + (1 - away).relu() ** 4 / 6
        smooth = (self.spacing * place.sign() * part * self.raw_torque_splines).sum(dim=-1)
        by_cos, by_sin = (self.ripple(q) / self.frequencies.repeat(1, 2)).chunk(2, dim=-1)
        turned = torch.cat([by_sin, -by_cos], dim=-1)
        return (self.scale * (smooth + (turned * self.raw_torque_ripple).sum(dim=-1))).sum(dim=-1)

    def _cubes(self, q: Tensor) -> Tensor:
        """Six times the splines."""
        wide = (2 - self._places(q).abs()).relu()
        return torch.sub(wide**3, (wide - 1).relu() ** 3, alpha=4)

    def _places(self, q: Tensor) -> Tensor:
        """How far q is from each spline's middle, in spacings, (..., n, SPLINES)."""
        return (q / self.spacing.squeeze(-1)).unsqueeze(-1) - self.middles / self.spacing


Row = tuple[float, float, float]


class Bodies(NamedTuple):
    """All that moves rigidly with a joint, an entry for each; a body turns about its frame's z, or
    slides along it, by ratio * q + offset.
    """

    parent: tuple[int, ...]  # -1: the base
    joint: tuple[int, ...]
    revolute: tuple[bool, ...]
    ratio: tuple[float, ...]
    offset: tuple[float, ...]
    rotation: tuple[tuple[Row, Row, Row], ...]  # of the joint's frame in its parent's
    position: tuple[Row, ...]  # likewise [m]
    mass: tuple[float, ...]  # nominal m [kg]
    moment: tuple[Row, ...]  # nominal m c [kg m]
    inertia: tuple[Row, ...]  # nominal Ixx, Iyy, Izz about the joint [kg m^2]
    products: tuple[Row, ...]  # likewise Ixy, Ixz, Iyz


def skew(a: Tensor) -> Tensor:
    """[a]x, (..., 3, 3), with [a]x b = a x b."""
    x, y, z = a.unbind(dim=-1)
    zero = torch.zeros_like(x)
    rows = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1)
    return rows.reshape(*a.shape[:-1], 3, 3)


def twist_map(rotation: Tensor, position: Tensor) -> Tensor:
    """Takes twists (angular, linear) to a frame at ``position`` turned by ``rotation``^T, (6, 6)."""
    top = torch.cat([rotation, torch.zeros_like(rotation)], dim=1)
    return torch.cat([top, torch.cat([-rotation @ skew(position), rotation], dim=1)])


def transform_table(bodies: Bodies, index: int) -> Tensor:
    """A body's twist map from its parent's frame is table[0] + table[1] cos + table[2] sin, (3, 6, 6).

    A prismatic one's is table[0] + displacement table[1].
    """
    rotation = torch.stack([vector(row) for row in bodies.rotation[index]]).mT
    position = vector(bodies.position[index])
    table = torch.zeros(3, 6, 6, dtype=torch.float64)
    if bodies.revolute[index]:
        about = torch.zeros(3, 3, 3, dtype=torch.float64)
        about[0, 2, 2] = about[1, 0, 0] = about[1, 1, 1] = about[2, 0, 1] = 1
        about[2, 1, 0] = -1
        for term in range(3):
            table[term] = twist_map(about[term] @ rotation, position)
    else:
        table[0] = twist_map(rotation, position)
        table[1] = twist_map(rotation, position + rotation[2]) - table[0]
    return table


def motion_table(bodies: Bodies) -> tuple[Tensor, Tensor]:
    """Takes cos, sin and value of all displacements to what takes rows of twists from parents' frames.

    (36 bodies, 3 bodies), and what is added, (36 bodies,). Offsets of the displacements are in both.
    """
    count = len(bodies.parent)
    by_term = torch.zeros(count, 6, 6, 3, count, dtype=torch.float64)
    fixed = torch.zeros(count, 6, 6, dtype=torch.float64)
    for index, (revolute, offset) in enumerate(zip(bodies.revolute, bodies.offset, strict=True)):
        constant, first, second = transform_table(bodies, index).mT
        if revolute:
            cos, sin = math.cos(offset), math.sin(offset)
            by_term[index, :, :, 0, index] = cos * first + sin * second
            by_term[index, :, :, 1, index] = cos * second - sin * first
            fixed[index] = constant
        else:
            by_term[index, :, :, 2, index] = first
            fixed[index] = constant + offset * first
    return by_term.reshape(36 * count, 3 * count), fixed.flatten()


def crossed(twists: Tensor, others: Tensor) -> Tensor:
    """How twists that are carried along by ``twists`` change; columns, (..., 6, k) each.

    Featherstone's cross product of motion vectors (2008, eq. 2.31).
    """
    (w, u), (a, m) = twists.chunk(2, dim=-2), others.chunk(2, dim=-2)
    linear = torch.linalg.cross(w, m, dim=-2) + torch.linalg.cross(u, a, dim=-2)
    return torch.cat([torch.linalg.cross(w, a, dim=-2), linear], dim=-2)


def pushed_along(twists: Tensor, momenta: Tensor) -> Tensor:
    """How momenta that are carried along by ``twists`` change; columns, (..., 6, k) each.

    Featherstone's cross product of force vectors (2008, eq. 2.32).
    """
    (w, u), (n, f) = twists.chunk(2, dim=-2), momenta.chunk(2, dim=-2)
    angular = torch.linalg.cross(w, n, dim=-2) + torch.linalg.cross(u, f, dim=-2)
    return torch.cat([angular, torch.linalg.cross(w, f, dim=-2)], dim=-2)


def inertia_basis() -> Tensor:
    """Spatial inertias of bodies with one parameter one and the others zero, (10, 6, 6)."""
    basis = torch.zeros(10, 6, 6, dtype=torch.float64)
    basis[0, 3:, 3:] = torch.eye(3)
    for axis, unit in enumerate(torch.eye(3, dtype=torch.float64)):
        basis[1 + axis, :3, 3:], basis[1 + axis, 3:, :3] = skew(unit), -skew(unit)
    for place, (row, column) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
        basis[4 + place, row, column] = basis[4 + place, column, row] = 1
    return basis


def pseudo_inertia(ten: Tensor) -> Tensor:
    """[[tr(I)/2 - I, m c], [(m c)^T, m]], (..., 4, 4), of (m, m c, I), (..., 10).

    It is positive definite exactly where some distribution of mass has these parameters (Wensing,
    Kim and Slotine, IEEE RA-L 3:60, 2018).
    """
    m, x, y, z, xx, xy, xz, yy, yz, zz = ten.unbind(dim=-1)
    half = (xx + yy + zz) / 2
    rows = [half - xx, -xy, -xz, x, -xy, half - yy, -yz, y, -xz, -yz, half - zz, z, x, y, z, m]
    return torch.stack(rows, dim=-1).reshape(*ten.shape[:-1], 4, 4)


class InertialParameters(nn.Module):
    """Trained inertial parameters of rigid bodies, possible ones for all weights; zero is nominal.

    A body's pseudo-inertia is C T T^T C^T, with C of the nominal body and T lower triangular, its
    diagonal exponentials (Rucker and Wensing, IEEE RA-L 7:4352, 2022).
    """

    factors: Tensor
    triangle: Tensor

    def __init__(self, bodies: Bodies) -> None:
        super().__init__()
        columns = zip(bodies.mass, bodies.moment, bodies.inertia, bodies.products, strict=True)
        nominal = torch.stack(
            [
                vector((m, *moment, xx, xy, xz, yy, yz, zz))
                for m, moment, (xx, yy, zz), (xy, xz, yz) in columns
            ]
        )
        self.register_buffer("factors", torch.linalg.cholesky(pseudo_inertia(nominal)))
        row, column = torch.tril_indices(4, 4)
        self.register_buffer("triangle", torch.eye(16, dtype=torch.float64)[4 * row + column])
        self.raw = nn.Parameter(torch.zeros(len(bodies.mass), 10, dtype=torch.float64))

    def forward(self) -> Tensor:
        """By body (m, m c, Ixx, Ixy, Ixz, Iyy, Iyz, Izz) about its joint's frame, (bodies, 10)."""
        on_diagonal = self.triangle[:, ::5].sum(dim=1) > 0
        lower = torch.where(on_diagonal, self.raw.exp(), self.raw) @ self.triangle
        root = self.factors @ lower.reshape(-1, 4, 4)
        pseudo = root @ root.mT
        moments, tensor = pseudo[:, 3, :3], -pseudo[:, :3, :3]
        trace = -tensor.diagonal(dim1=-2, dim2=-1).sum(dim=-1)
        xx, yy, zz = (trace.unsqueeze(-1) + tensor.diagonal(dim1=-2, dim2=-1)).unbind(dim=-1)
        xy, xz, yz = tensor[:, 0, 1], tensor[:, 0, 2], tensor[:, 1, 2]
        six = torch.stack([xx, xy, xz, yy, yz, zz], dim=-1)
        return torch.cat([pseudo[:, 3, 3:], moments, six], dim=-1)


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


# where the constants start, relative to a joint's usual friction and speed
STRIBECK = 0.3  # dry friction that only slow motion has


STRIBECK_VELOCITY = 0.03  # where that has faded


SMOOTHING_VELOCITY = 0.006  # over which dry friction turns around


SATURATION_VELOCITY = 0.2  # where viscous friction begins to grow more slowly


LOAD_DEPENDENCE = 0.03  # dry friction by gravity torque


class FrictionConstants(NamedTuple):
    """By joint, (n,), all positive."""

    viscous: Tensor  # [Nm s/rad, N s/m]
    saturation: Tensor  # viscous friction that stops growing [Nm, N]
    saturation_velocity: Tensor  # [rad/s, m/s]
    coulomb: Tensor  # [Nm, N]
    stribeck: Tensor  # [Nm, N]
    stribeck_velocity: Tensor  # [rad/s, m/s]
    coulomb_smoothing_velocity: Tensor  # [rad/s, m/s]
    load_dependence: Tensor  # dry friction by gravity torque
    bristle_fractions: Tensor  # of dry friction, (n, K); a joint's add up to one


class FrictionLaws(nn.Module):
    """Friction which resists whatever the weights are: they are logarithms.

    viscous qd + saturation tanh(qd / saturation_velocity)
    + (coulomb + stribeck exp(-(qd / stribeck_velocity)^2) + load_dependence |gravity torque|) direction.

    The direction, from -1 to 1, is that of the bristles, sum of fraction z / reach; without them, or
    where nothing is known of the way here, tanh(qd / coulomb_smoothing_velocity).
    """

    nominal: Tensor
    speed: Tensor
    raw_coulomb_smoothing_velocity: nn.Parameter | None
    raw_bristle_fractions: nn.Parameter | None

    def __init__(self, joints: Joints, reach: Sequence[Sequence[float]] = ()) -> None:
        super().__init__()
        self.register_buffer("nominal", vector(joints.friction))
        self.register_buffer("speed", vector(joints.speed))
        self.bristles = Bristles(reach or [[]] * joints.n)
        start = torch.zeros(joints.n, dtype=torch.float64)
        self.raw_viscous = nn.Parameter(start.clone())
        self.raw_saturation = nn.Parameter(start.clone())
        self.raw_saturation_velocity = nn.Parameter(start.clone())
        self.raw_coulomb = nn.Parameter(start.clone())
        self.raw_stribeck = nn.Parameter(start.clone())
        self.raw_stribeck_velocity = nn.Parameter(start.clone())
        self.raw_load_dependence = nn.Parameter(start.clone())
        # dry friction turns around by displacement or by velocity, never by both
        smoothing = None if reach else nn.Parameter(start.clone())
        self.register_parameter("raw_coulomb_smoothing_velocity", smoothing)
        fractions = nn.Parameter(torch.zeros_like(self.bristles.reach)) if reach else None
        self.register_parameter("raw_bristle_fractions", fractions)

    def prepare(self) -> FrictionConstants:
        """The constants, in their units."""
        size, speed = self.nominal, self.speed
        smoothing, fractions = self.raw_coulomb_smoothing_velocity, self.raw_bristle_fractions
        return FrictionConstants(
            viscous=size / speed * self.raw_viscous.exp(),
            saturation=size * self.raw_saturation.exp(),
            saturation_velocity=SATURATION_VELOCITY * speed * self.raw_saturation_velocity.exp(),
            coulomb=size * self.raw_coulomb.exp(),
            stribeck=STRIBECK * size * self.raw_stribeck.exp(),
            stribeck_velocity=STRIBECK_VELOCITY * speed * self.raw_stribeck_velocity.exp(),
            coulomb_smoothing_velocity=SMOOTHING_VELOCITY
            * speed
            * (1 if smoothing is None else smoothing.exp()),
            load_dependence=LOAD_DEPENDENCE * size.sign() * self.raw_load_dependence.exp(),
            bristle_fractions=self.bristles.reach if fractions is None else fractions.softmax(dim=-1),
        )

    def resistance(self, qd: Tensor, gravity: Tensor, constants: FrictionConstants) -> Tensor:
        """The diagonal of D, (..., n): friction torque by velocity, of joints that slide."""
        c = constants
        slope = tanh_ratio(qd / c.coulomb_smoothing_velocity) / c.coulomb_smoothing_velocity
        return self.viscosity(qd, c) + self.dry(qd, gravity, c) * slope

    def forward(
        self, qd: Tensor, gravity: Tensor, constants: FrictionConstants, z: Tensor | None = None
    ) -> Tensor:
        """The friction torque, (..., n) [Nm, N], under this gravity torque, of bristles at z, (..., n, K)."""
        c = constants
        if z is None:
            direction = (qd / c.coulomb_smoothing_velocity).tanh()
        else:
            direction = (c.bristle_fractions / self.bristles.reach * z).sum(dim=-1)
        saturating = c.saturation * (qd / c.saturation_velocity).tanh()
        return c.viscous * qd + saturating + self.dry(qd, gravity, c) * direction

    def sliding(self, qd: Tensor) -> Tensor:
        """The bristles z, (..., n, K), of joints that have long gone this way."""
        direction = (qd / self.prepare().coulomb_smoothing_velocity).tanh()
        return direction.unsqueeze(-1) * self.bristles.reach

    def stored_energy(self, z: Tensor, constants: FrictionConstants) -> Tensor:
        """What the bristles of Coulomb friction give back, (...) [J]."""
        stored = constants.bristle_fractions * z.square() / self.bristles.reach
        return 0.5 * (constants.coulomb * stored.sum(dim=-1)).sum(dim=-1)

    @staticmethod
    def viscosity(qd: Tensor, c: FrictionConstants) -> Tensor:
        """Torque by velocity, (..., n)."""
        return c.viscous + c.saturation / c.saturation_velocity * tanh_ratio(qd / c.saturation_velocity)

    @staticmethod
    def dry(qd: Tensor, gravity: Tensor, c: FrictionConstants) -> Tensor:
        """The size of dry friction, (..., n) [Nm, N]."""
        slow = (-((qd / c.stribeck_velocity) ** 2)).exp()
        return c.coulomb + c.stribeck * slow + c.load_dependence * gravity.abs()


def tanh_ratio(x: Tensor) -> Tensor:
    """tanh(x) / x."""
    near = x.abs() < 1e-4
    safe = torch.where(near, torch.ones_like(x), x)
    return torch.where(near, 1 - x**2 / 3, safe.tanh() / safe)


PART = 0.9  # of the drives' inertia, which the residual may take away at most


NEVER = 1e30  # how large a function may be by an entry where it does not stand


class ResidualMassPrepared(NamedTuple):
    """What depends on the weights alone."""

    layers: Any  # of the network
    functions: Tensor  # what each function adds to M at its largest, (functions, n n)
    constant: Tensor  # what the constants add, (n n,)


class ResidualMass(nn.Module):
    """R(q), (..., n, n), with ``entries`` saying where functions and constants stand.

    Each is its bound times the tanh of a network's output, or of a weight: the bounds are such that
    ``armature`` + R is positive definite for all q and all weights (see ``bounds``).
    """

    basis: Tensor  # (functions + constants, n, n)
    inverse: Tensor  # one by |basis|, NEVER where that is zero

    def __init__(
        self, joints: Joints, entries: Entries, functions: int, constants: int, network: Network | None
    ) -> None:
        super().__init__()
        n = self.n = joints.n
        basis = torch.cat(entry_basis(entries, functions, constants)).reshape(-1, n, n)
        stands = basis != 0
        self.register_buffer("basis", basis)
        self.register_buffer("inverse", torch.where(stands, 1 / basis.abs(), NEVER))
        self.part = PART / float(stands.sum(dim=(0, 2)).max())  # of all that meet in a row of M
        self.functions, self.network = functions, network
        self.raw_constants = nn.Parameter(torch.zeros(constants, dtype=torch.float64))

    def bounds(self, armature: Tensor) -> Tensor:
        """How large each function and constant may be, beside an armature matrix, (n, n).

        armature - diag(d) is positive semi-definite for d = 1 / (row sums of |armature^-1|), and so is
        diag(d) - R where no row of |R| / sqrt(d d^T) adds up to more than one: by diagonal dominance both.
        """
        root = torch.linalg.inv(armature).abs().sum(dim=-1).rsqrt()
        pairs = root.unsqueeze(-1) * root
        smallest: Tensor = (pairs * self.inverse).amin(dim=(-2, -1))
        return self.part * smallest

    def prepare(self, armature: Tensor) -> ResidualMassPrepared:
        """All that depends on the weights alone."""
        rows = self.bounds(armature).unsqueeze(-1) * self.basis.flatten(1)
        functions, constants = rows.tensor_split((self.functions,))
        layers = None
        if self.network is not None:
            identity = torch.eye(self.functions, dtype=rows.dtype, device=rows.device)
            layers = self.network.prepare(identity, rows.new_zeros(self.functions))
        return ResidualMassPrepared(layers, functions, self.raw_constants.tanh() @ constants)

    def forward(self, encoded: Tensor, prepared: ResidualMassPrepared) -> tuple[Tensor, Any]:
        """R(q), and what its derivatives need."""
        if self.network is None:
            return self._square(prepared.constant).expand(*encoded.shape[:-1], -1, -1), None
        y, residuals = self.network(encoded, prepared.layers)
        height = y.tanh()
        rows = F.linear(height, prepared.functions.mT, prepared.constant)
        return self._square(rows), (residuals, 1 - height * height, prepared.functions)

    def _square(self, rows: Tensor) -> Tensor:
        """(..., n n) as (..., n, n)."""
        return rows.reshape(*rows.shape[:-1], self.n, self.n)

    def coriolis(self, rate: Tensor, qd: Tensor, residuals: Any) -> tuple[Tensor, Tensor]:
        """dR/dt qd, (..., n), where the encoding changes at this rate, and what ``kinetic_vjp`` gives."""
        if self.network is None:
            return torch.zeros_like(qd), torch.zeros_like(rate)
        network, slope, functions = residuals
        moved = self._moved(qd, functions)
        by_encoded = self.network.vjp(network, 0.5 * slope * applied(moved, qd))
        return combined(slope * self.network.jvp(network, rate), moved), by_encoded

    def kinetic_vjp(self, encoded: Tensor, qd: Tensor, residuals: Any) -> Tensor:
        """The derivative of 1/2 qd^T R(q) qd by the encoding."""
        if self.network is None:
            return torch.zeros_like(encoded)
        network, slope, functions = residuals
        by_encoded: Tensor = self.network.vjp(network, 0.5 * slope * applied(self._moved(qd, functions), qd))
        return by_encoded

    def _moved(self, qd: Tensor, functions: Tensor) -> Tensor:
        """What each function adds to R qd at its largest, (..., functions, n)."""
        return blocks(F.linear(qd, functions.reshape(-1, self.n)), self.n)


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


class Chain(NamedTuple):
    """The bodies at a position; 6 numbers a body, side by side."""

    frames: Tensor  # takes twists from the base's frame to the bodies', (..., 6, 6 bodies)
    axes: Tensor  # twists that bodies have by their own displacements, in the base's frame, (..., 6, bodies)
    twists: Tensor  # by joint velocity, in the bodies' frames, (..., n, 6 bodies)
    weight: Tensor  # acceleration that stands for gravity, likewise, (..., 6 bodies)


class BodyChain(nn.Module):
    """Bodies that turn about or slide along axes, each carried by another or by the base.

    Spatial vectors are (angular, linear), as in Featherstone, Rigid Body Dynamics Algorithms, 2008; they
    are rows in the bodies' frames and columns in the base's. Only frames are followed body by body: sums
    over all that carries a body, or that it carries, are products with a mask, so few operations are left.
    """

    table: (
        Tensor  # takes cos, sin and value of the displacements to frames in parents', (36 bodies, 3 bodies)
    )
    fixed: Tensor  # what is added there, (36 bodies,)
    reading: Tensor  # where axes stand in ``frames``, (6 bodies, bodies)
    carriers: Tensor  # whether a body carries another, or is it, (bodies, bodies)
    carried: Tensor  # likewise, six times each, (bodies, 6 bodies)
    base: Tensor  # acceleration of the base that stands for gravity, (6,)
    ratios: Tensor  # displacements by q, (bodies, n)

    def __init__(self, n: int, bodies: Bodies, gravity: tuple[float, float, float]) -> None:
        super().__init__()
        self.parents, count = bodies.parent, len(bodies.parent)
        reading = torch.zeros(count, 6, count, dtype=torch.float64)
        carriers = torch.eye(count, dtype=torch.float64)
        ratios = torch.zeros(count, n, dtype=torch.float64)
        for index, parent in enumerate(bodies.parent):
            ratios[index, bodies.joint[index]] = bodies.ratio[index]
            # an inverse's rows are columns whose halves are swapped
            reading[index, 5 if bodies.revolute[index] else 2, index] = 1
            if parent >= 0:
                carriers[:, index] += carriers[:, parent]
        table, fixed = motion_table(bodies)
        self.register_buffer("table", table)
        self.register_buffer("fixed", fixed)
        self.register_buffer("reading", reading.flatten(0, 1))
        self.register_buffer("carriers", carriers)
        self.register_buffer("carried", carriers.repeat_interleave(6, dim=1))
        self.register_buffer("base", vector((0, 0, 0, *(-g for g in gravity))))
        self.register_buffer("ratios", ratios)
        self.single = torch.equal(ratios, torch.eye(n).double())  # no joint moves several bodies

    def forward(self, q: Tensor) -> Chain:
        """The bodies at q, (..., n)."""
        value = self._by_bodies(q)
        features = torch.cat([value.cos(), value.sin(), value], dim=-1)
        own = blocks(F.linear(features, self.table, self.fixed), 6, 6).unbind(dim=-3)
        placed: list[Tensor] = []
        for index, parent in enumerate(self.parents):
            placed.append(own[index] if parent < 0 else placed[parent] @ own[index])
        frames = torch.cat(placed, dim=-1)
        axes = (frames @ self.reading).roll(3, dims=-2)
        twists = (axes.mT @ frames) * self.carried
        twists = twists if self.single else self.ratios.mT @ twists
        return Chain(frames, axes, twists, combined(self.base, frames))

    def _by_bodies(self, joints: Tensor) -> Tensor:
        """What is given by joint, (..., n), for the bodies that they move, (..., bodies)."""
        return joints if self.single else joints @ self.ratios.mT

    def turning(self, at: Chain, qd: Tensor) -> tuple[Tensor, Tensor]:
        """The bodies' twists, and how these turn the bodies' axes; in the base's frame, (..., 6, bodies)."""
        twists = (at.axes * self._by_bodies(qd).unsqueeze(-2)) @ self.carriers
        return twists, crossed(twists, at.axes)

    def accelerations(self, at: Chain, qd: Tensor, turning: Tensor) -> Tensor:
        """The bodies' accelerations at steady qd, gravity taken as one, (..., 6 bodies)."""
        steady = (turning * self._by_bodies(qd).unsqueeze(-2)) @ self.carriers
        bodies = blocks(at.frames, 6) * steady.unsqueeze(-1)
        return bodies.sum(dim=-3).flatten(-2) + at.weight

    def at_base(self, at: Chain, momenta: Tensor) -> Tensor:
        """Momenta of the bodies, (..., 6 bodies), in the base's frame, (..., 6, bodies)."""
        return blocks(at.frames * momenta.unsqueeze(-2), 6).sum(dim=-1)

    def by_joints(self, axes: Tensor, wrenches: Tensor) -> Tensor:
        """What joints feel along ``axes`` of wrenches on all that they carry, (..., n)."""
        felt = (axes * (wrenches @ self.carriers.mT)).sum(dim=-2)
        return felt if self.single else felt @ self.ratios

    def energy(self, at: Chain, inertia: Tensor) -> Tensor:
        """The bodies' energy in gravity, (...) [J]; zero at the base's origin."""
        # of all bodies together; the moment of mass stands in the inertia's upper right block
        whole = at.frames @ inertia @ at.frames.mT
        moment = torch.stack([whole[..., 2, 4], whole[..., 0, 5], whole[..., 1, 3]], dim=-1)
        return applied(moment.unsqueeze(-2), self.base[3:]).squeeze(-1)

    def regressor(self, q: Tensor, qd: Tensor, qdd: Tensor, basis: Tensor) -> Tensor:
        """Y, (..., n, 10 bodies): Y @ inertial parameters is the bodies' torque.

        basis: ``inertia_basis()``.
        """
        at = self(q)
        rises = self.accelerations(at, qd, self.turning(at, qd)[1]) + combined(qdd, at.twists)
        rises, twists = (blocks(rows, 6) for rows in (rises, combined(qd, at.twists)))
        # by body and parameter: (..., bodies, 6, 10)
        momenta = torch.tensordot(twists, basis, dims=([-1], [2])).mT
        wrenches = torch.tensordot(rises, basis, dims=([-1], [2])).mT
        wrenches = wrenches + pushed_along(twists.unsqueeze(-1), momenta)
        columns = blocks(at.twists, 6).transpose(-3, -2)  # (..., bodies, n, 6)
        rows: Tensor = (columns @ wrenches).transpose(-3, -2)
        return rows.reshape(*q.shape, 10 * len(self.parents))


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
    offset: Tensor  # what the measured torque shows without any, (n,)
    compensation: Tensor  # what the drives add by velocity, unseen, (n,)
    residual: Any = None  # of what a model has beside rigid bodies


class Motion(NamedTuple):
    """What is computed of a position alone."""

    chain: Chain
    momenta: Tensor  # of the chain's twists, by joint velocity, (..., n, 6 bodies)
    gravity: Tensor  # dV/dq of the bodies, (..., n)
    residual: Any = None  # of what a model has beside rigid bodies


class RigidBodyDynamics(PortHamiltonian):
    """Rigid bodies with trained inertial parameters, friction by laws, a trained torque offset."""

    basis: Tensor
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
        self.n, self.elements = joints.n, len(reach[0]) if reach else 0
        self.chain = BodyChain(joints.n, bodies, gravity)
        self.register_buffer("basis", inertia_basis())
        self.register_buffer("actuated", vector(float(x) for x in joints.actuated))
        self.inertial_parameters = InertialParameters(bodies)
        self.armature = Armature(joints)
        self.friction = FrictionLaws(joints, reach)
        self.input = input
        self.register_buffer("motors", self.input.motor_speeds())
        self.register_buffer("loads", torch.linalg.inv(self.motors))
        self.coupled = not torch.equal(self.motors, torch.eye(self.n).double())
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
            offset=self.torque_offset(),
            compensation=self.friction_compensation(),
        )

    def configuration(self, q: Tensor, prepared: RigidPrepared) -> Motion:
        """How the bodies may move at q, and what they weigh there."""
        chain: Chain = self.chain(q)
        momenta = chain.twists @ prepared.inertia
        return Motion(chain, momenta, applied(momenta, chain.weight))

    def mass_at(self, at: Motion, prepared: RigidPrepared) -> tuple[Tensor, None]:
        """M(q), (..., n, n)."""
        return at.momenta @ at.chain.twists.mT + prepared.armature, None

    def energy_at(self, at: Motion, prepared: RigidPrepared) -> Tensor:
        """V(q), (...) [J]; zero for a mass at the base's origin."""
        return self.chain.energy(at.chain, prepared.inertia)

    def gravity_at(self, at: Motion, prepared: RigidPrepared) -> Tensor:
        """dV/dq, (..., n) [Nm, N]."""
        return at.gravity

    def lagrangian_gradient(self, at: Motion, qd: Tensor, residuals: Any, prepared: RigidPrepared) -> Tensor:
        """d/dq of 1/2 qd^T M(q) qd - V(q), (..., n).

        The kinetic part: the momentum of all that a joint carries, by what its displacement adds to
        their twist.
        """
        momenta = self.chain.at_base(at.chain, combined(qd, at.momenta))
        return self.chain.by_joints(self.chain.turning(at.chain, qd)[1], momenta) - at.gravity

    def nonlinear_at(self, at: Motion, qd: Tensor, residuals: Any, prepared: RigidPrepared) -> Tensor:
        """The torque that holds qd steady without friction, (..., n), by Newton and Euler."""
        chain = self.chain
        twists, turning = chain.turning(at.chain, qd)
        rising = applied(at.momenta, chain.accelerations(at.chain, qd, turning))
        pushed = pushed_along(twists, chain.at_base(at.chain, combined(qd, at.momenta)))
        return rising + chain.by_joints(at.chain.axes, pushed)

    def regressor(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """Y, (..., n, 10 bodies): Y @ inertial parameters is the bodies' torque."""
        return self.chain.regressor(q, qd, qdd, self.basis)

    def residual_torque(self, q: Tensor, qd: Tensor, qdd: Tensor, prepared: RigidPrepared) -> Tensor:
        """What else than bodies, drives and friction takes torque, (..., n) [Nm, N]: nothing."""
        return torch.zeros_like(q)

    def friction_factor(self, q: Tensor) -> Tensor:
        """How much more friction the drives have at q than their laws say, (..., n): nowhere any."""
        return torch.ones_like(q)

    def _varied(self, friction: Tensor, at: Motion) -> Tensor:
        """The laws' friction of the drives as it is at this position, (..., n)."""
        return friction

    def _by_motors(self, joints: Tensor, matrix: Tensor) -> Tensor:
        """Rows times a matrix that is the identity where each motor moves its own joint alone."""
        return joints @ matrix if self.coupled else joints

    def friction_at(self, at: Motion, qd: Tensor, prepared: RigidPrepared, z: Tensor | None = None) -> Tensor:
        """The friction torque C^T f(C qd), (..., n) [Nm, N]."""
        speeds, loads = self._by_motors(qd, self.motors.mT), self._by_motors(at.gravity, self.loads)
        torque: Tensor = self.friction(speeds, loads, prepared.friction, z)
        return self._by_motors(self._varied(torque, at), self.motors)

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
        resistance = self._varied(resistance, at)
        return self.motors.mT @ (resistance.unsqueeze(-1) * self.motors)

    def input_at(self, at: Motion, prepared: RigidPrepared) -> Tensor:
        """G, (..., n, n)."""
        matrix: Tensor = self.input(at.gravity, prepared.input)
        return matrix

    def input_force(self, at: Motion, qd: Tensor, tau: Tensor, prepared: RigidPrepared) -> Tensor:
        """G (tau - torque offset) + friction compensation qd, (..., n) [Nm, N]."""
        force: Tensor = self.input.force(at.gravity, tau - prepared.offset, prepared.input)
        return force + prepared.compensation * qd

    def input_torque(self, at: Motion, qd: Tensor, force: Tensor, prepared: RigidPrepared) -> Tensor:
        """The tau, (..., n), that is measured while the drives make this force."""
        shown = force - prepared.compensation * qd
        tau: Tensor = self.input.solve(at.gravity, shown, prepared.input)
        return tau + prepared.offset


class ResidualPrepared(NamedTuple):
    """What depends on the weights alone."""

    mass: Any
    potential: Any
    functions: JointFunctionWeights


class ResidualMotion(NamedTuple):
    """What residuals read of a position."""

    q: Tensor
    encoded: Tensor
    torque: Tensor  # of the joints' own functions, (..., n) [Nm, N]
    factor: Tensor  # on friction, (..., n)


class ResidualDynamics(RigidBodyDynamics):
    """Rigid bodies with residuals in M, V and friction; with their weights zero they are bodies alone.

    M = that of bodies and drives + R(q), positive definite for all weights (see ``ResidualMass``).
    V = that of bodies + a network's + each joint's own. Friction is multiplied by a positive factor.
    """

    def __init__(
        self,
        joints: Joints,
        bodies: Bodies,
        gravity: tuple[float, float, float],
        input: DriveInput,
        mass: ResidualMass,
        potential: LearnedPotential | None,
        reach: Sequence[Sequence[float]] = (),
    ) -> None:
        super().__init__(joints, bodies, gravity, input, reach)
        self.encoding = JointEncoding(joints)
        self.joint_functions = JointFunctions(joints)
        self.residual_mass = mass
        self.residual_potential = potential

    def prepare(self, definite: bool = True) -> RigidPrepared:
        """All that depends on the weights alone; holds until they change."""
        prepared = super().prepare(definite)
        potential = None if self.residual_potential is None else self.residual_potential.prepare()
        mass = self.residual_mass.prepare(prepared.armature)
        functions = self.joint_functions.prepare()
        return prepared._replace(residual=ResidualPrepared(mass, potential, functions))

    def configuration(self, q: Tensor, prepared: RigidPrepared) -> Motion:
        """How the bodies may move at q, and what residuals read of q."""
        return super().configuration(q, prepared)._replace(residual=self._read(q, prepared))

    def _read(self, q: Tensor, prepared: RigidPrepared) -> ResidualMotion:
        return ResidualMotion(q, self.encoding(q), *self.joint_functions(q, prepared.residual.functions))

    def mass_at(self, at: Motion, prepared: RigidPrepared) -> tuple[Tensor, Any]:
        """M(q), (..., n, n), and what its derivatives need."""
        more, residuals = self.residual_mass(at.residual.encoded, prepared.residual.mass)
        return super().mass_at(at, prepared)[0] + more, residuals

    def energy_at(self, at: Motion, prepared: RigidPrepared) -> Tensor:
        """V(q), (...) [J]."""
        energy = super().energy_at(at, prepared) + self.joint_functions.energy(at.residual.q)
        if self.residual_potential is None:
            return energy
        more: Tensor = self.residual_potential(at.residual.encoded, prepared.residual.potential)
        return energy + more

    def gravity_at(self, at: Motion, prepared: RigidPrepared) -> Tensor:
        """dV/dq, (..., n) [Nm, N]."""
        kinetic = torch.zeros_like(at.residual.encoded)
        return at.gravity - self._gradient(at.residual, kinetic, prepared)

    def lagrangian_gradient(self, at: Motion, qd: Tensor, residuals: Any, prepared: RigidPrepared) -> Tensor:
        """d/dq of 1/2 qd^T M(q) qd - V(q), (..., n)."""
        kinetic = self.residual_mass.kinetic_vjp(at.residual.encoded, qd, residuals)
        own = self._gradient(at.residual, kinetic, prepared)
        return super().lagrangian_gradient(at, qd, None, prepared) + own

    def nonlinear_at(self, at: Motion, qd: Tensor, residuals: Any, prepared: RigidPrepared) -> Tensor:
        """The torque that holds qd steady without friction, (..., n)."""
        own = self._nonlinear(at.residual, qd, residuals, prepared)
        return super().nonlinear_at(at, qd, None, prepared) + own

    def residual_torque(self, q: Tensor, qd: Tensor, qdd: Tensor, prepared: RigidPrepared) -> Tensor:
        """What the residuals of M and V take, (..., n) [Nm, N]."""
        read = self._read(q, prepared)
        mass, residuals = self.residual_mass(read.encoded, prepared.residual.mass)
        return applied(mass, qdd) + self._nonlinear(read, qd, residuals, prepared)

    def friction_factor(self, q: Tensor) -> Tensor:
        """How much more friction the drives have at q than their laws say, (..., n)."""
        factor: Tensor = self.joint_functions(q, self.joint_functions.prepare())[1]
        return factor

    def _varied(self, friction: Tensor, at: Motion) -> Tensor:
        """The laws' friction of the drives as it is at this position, (..., n)."""
        factor: Tensor = at.residual.factor
        return factor * friction

    def _nonlinear(self, read: ResidualMotion, qd: Tensor, residuals: Any, prepared: RigidPrepared) -> Tensor:
        """dR/dt qd - d/dq of what the residuals add to 1/2 qd^T M(q) qd - V(q), (..., n)."""
        rate = self.encoding.jvp(read.encoded, qd)
        moved, kinetic = self.residual_mass.coriolis(rate, qd, residuals)
        return moved - self._gradient(read, kinetic, prepared)

    def _gradient(self, read: ResidualMotion, kinetic: Tensor, prepared: RigidPrepared) -> Tensor:
        """d/dq of what the residuals add to 1/2 qd^T M(q) qd - V(q), (..., n); kinetic: by the encoding."""
        if self.residual_potential is not None:
            kinetic = kinetic - self.residual_potential.vjp(read.encoded, prepared.residual.potential)
        gradient: Tensor = self.encoding.vjp(read.encoded, kinetic)
        return gradient - read.torque
