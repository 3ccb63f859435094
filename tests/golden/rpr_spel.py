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

Record, by which `spelgen check` tells whether this module is up to date:

    robot: "rpr"
    urdf: "rpr.urdf"
    urdf_sha256: "aaacb65e5fa6a4caf626114ddf8869514f479b568dae43957e41214d3c6eff8d"
    spec_sha256: "0830195eaa09f089277fa7ea50137cea19adbbdad6dc81e397963ce36c1baf30"
    option assume: "kinematics"
    option depth: 2
    option joints: null
    option preset: "minimal"
    option snap_tolerance: 0.002
    option tip: null
    option width: 64
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

# the lower triangle of a symmetric matrix: row, column, factor
Entries = tuple[tuple[int, int, float], ...]


class Joint(NamedTuple):
    """A joint; angles are in rad, lengths in m."""

    name: str
    revolute: bool
    center: float  # a sliding joint is read as (q - center) / reach
    reach: float
    speed: float  # usual speed
    friction: float  # usual size of the friction torque
    rotor: float  # what its drive adds to M at the start: rotor inertia times gear squared
    mass_share: float  # how much M changes with it, relative to the joint that moves M most
    potential_share: float  # the same of V
    actuated: bool


class Constant(NamedTuple):
    """A trained number c that enters M as c A; it starts at ``start``, in units of ``scale``."""

    start: float
    scale: float
    entries: Entries  # of A


class Output(NamedTuple):
    """A learned function f = mean + scale * network of some joints, which enters M as f B."""

    joints: tuple[int, ...]
    mean: float
    scale: float
    entries: Entries  # of B


JOINTS = (
    Joint(
        name="joint1",
        revolute=True,
        center=0.0,
        reach=2.96706,
        speed=3.0,
        friction=0.4,
        rotor=0.133,
        mass_share=0.02,
        potential_share=0.02,
        actuated=True,
    ),
    Joint(
        name="joint2",
        revolute=False,
        center=0.7875,
        reach=0.4825,
        speed=1.0,
        friction=0.4,
        rotor=0.4,
        mass_share=1.0,
        potential_share=0.02,
        actuated=True,
    ),
    Joint(
        name="joint3",
        revolute=True,
        center=0.0,
        reach=2.96706,
        speed=6.0,
        friction=0.4,
        rotor=0.0667,
        mass_share=0.518,
        potential_share=1.0,
        actuated=True,
    ),
)

# M(q) = sum_k c_k A_k + sum_j f_j(q) B_j
CONSTANTS: tuple[Constant, ...] = (
    Constant(start=0.0101411, scale=0.0101411, entries=((2, 2, 1.0),)),
    Constant(start=5.33, scale=5.33, entries=((1, 1, 1.0),)),
)
OUTPUTS = (
    Output(joints=(2,), mean=-0.00167665, scale=1.36528, entries=((1, 0, 1.0),)),
    Output(joints=(1, 2), mean=-0.00154309, scale=0.0595527, entries=((2, 0, 1.0),)),
    Output(joints=(1, 2), mean=139.887, scale=12.6351, entries=((0, 0, 1.0),)),
)
# in each hidden layer: the joints that some units read, and how many units do
MASS_HIDDEN = (((2,), 21), ((1, 2), 43))
MASS_DEPTH = 2
GUARD = 0.08  # least eigenvalue of M, relative to its nominal mean, that is left as it is
POTENTIAL_JOINTS = (2,)  # the joints that V depends on
POTENTIAL_HIDDEN = (32, 32)
POTENTIAL_SCALE = 0.703291  # [J]
FRICTION_HIDDEN = 8
SLOW = 0.03  # below this share of its usual speed a joint's dry friction fades to zero
PLACE_SHARE = 0.1  # how much friction's networks see of where a joint is, relative to its speed


def vector(values: Iterable[float]) -> Tensor:
    """The values as a float64 tensor."""
    return torch.tensor(list(values), dtype=torch.float64)


def stacked(matrices: list[Entries]) -> Tensor:
    """The symmetric n x n matrices with these entries as rows, (matrices, n n)."""
    n = len(JOINTS)
    rows = torch.zeros(len(matrices), n, n, dtype=torch.float64)
    for matrix, entries in zip(rows, matrices, strict=True):
        for row, column, factor in entries:
            matrix[row, column] = matrix[column, row] = factor
    return rows.reshape(len(matrices), n * n)


Trace = tuple[Tensor, tuple[Tensor, ...], tuple[Tensor, ...]]


class Network(nn.Module):
    """A tanh network y(q), with its derivatives written out.

    It reads cos q and sin q of turning joints and the scaled q of sliding ones, times each joint's
    ``share``. ``layers`` names, unit by unit, the joints that each layer's units may read; weights
    between others are masked, so that a unit has no path to a joint it must not depend on.
    """

    turning: Tensor
    sliding: Tensor
    center: Tensor
    reach: Tensor
    select: Tensor

    def __init__(
        self,
        joints: tuple[int, ...],
        share: Tensor,
        layers: tuple[tuple[frozenset[int], ...], ...],
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        turning = [joint for joint in joints if JOINTS[joint].revolute]
        sliding = [joint for joint in joints if not JOINTS[joint].revolute]
        self.register_buffer("turning", torch.tensor(turning, dtype=torch.long))
        self.register_buffer("sliding", torch.tensor(sliding, dtype=torch.long))
        self.register_buffer("center", vector(JOINTS[i].center for i in sliding))
        self.register_buffer("reach", vector(JOINTS[i].reach for i in sliding))
        # spreads derivatives with respect to the joints read over all of q
        everything = torch.eye(len(JOINTS), dtype=torch.float64)
        self.register_buffer("select", everything[turning + sliding])
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        below = tuple(frozenset((joint,)) for joint in turning + turning + sliding)
        for index, units in enumerate(layers):
            allowed = [[float(lower <= upper) for lower in below] for upper in units]
            mask = torch.tensor(allowed, dtype=torch.float64)
            weight = torch.randn(mask.shape, dtype=torch.float64, generator=generator)
            self.weights.append(nn.Parameter(weight / mask.sum(dim=1, keepdim=True).sqrt()))
            if index == 0:
                mask = mask * share[turning + turning + sliding]
            self.register_buffer(f"mask{index}", mask)
            self.biases.append(nn.Parameter(torch.zeros(len(units), dtype=torch.float64)))
            below = units
        nn.init.zeros_(self.weights[-1])  # so that the model starts at its nominal means

    def forward(self, q: Tensor) -> tuple[Tensor, Trace]:
        """y, (..., outputs), of q, (..., n); and what ``pull`` and ``push`` need."""
        angle, slide = q[..., self.turning], q[..., self.sliding]
        features = torch.cat([angle.cos(), angle.sin(), (slide - self.center) / self.reach], dim=-1)
        weights = tuple(w * self.get_buffer(f"mask{i}") for i, w in enumerate(self.weights))
        layer, hidden = features, []
        for weight, bias in zip(weights[:-1], self.biases, strict=False):
            layer = torch.tanh(F.linear(layer, weight, bias))
            hidden.append(layer)
        return F.linear(layer, weights[-1], self.biases[-1]), (features, tuple(hidden), weights)

    def pull(self, trace: Trace, cotangent: Tensor) -> Tensor:
        """The reverse sweep: cotangent, (..., outputs), times dy/dq; (..., n)."""
        features, hidden, weights = trace
        layer = cotangent @ weights[-1]
        for weight, value in zip(reversed(weights[:-1]), reversed(hidden), strict=True):
            layer = (layer * (1 - value * value)) @ weight
        turns = len(self.turning)
        cos, sin, _ = features.tensor_split((turns, 2 * turns), dim=-1)
        by_cos, by_sin, by_slide = layer.tensor_split((turns, 2 * turns), dim=-1)
        return torch.cat([by_sin * cos - by_cos * sin, by_slide / self.reach], dim=-1) @ self.select

    def push(self, trace: Trace, qd: Tensor) -> Tensor:
        """The forward sweep: dy/dq times qd, (..., n); (..., outputs)."""
        features, hidden, weights = trace
        turns = len(self.turning)
        cos, sin, _ = features.tensor_split((turns, 2 * turns), dim=-1)
        rate = qd[..., self.turning]
        layer = torch.cat([-sin * rate, cos * rate, qd[..., self.sliding] / self.reach], dim=-1)
        for weight, value in zip(weights[:-1], hidden, strict=True):
            layer = F.linear(layer, weight) * (1 - value * value)
        return F.linear(layer, weights[-1])


class Friction(nn.Module):
    """Damping of each joint by its own q_i and qd_i: viscous, a constant, and dry, a network."""

    revolute: Tensor
    center: Tensor
    reach: Tensor
    speed: Tensor
    size: Tensor

    def __init__(self, generator: torch.Generator) -> None:
        super().__init__()
        joints, inputs = len(JOINTS), 4
        self.register_buffer("revolute", torch.tensor([joint.revolute for joint in JOINTS]))
        self.register_buffer("center", vector(joint.center for joint in JOINTS))
        self.register_buffer("reach", vector(joint.reach for joint in JOINTS))
        self.register_buffer("speed", vector(joint.speed for joint in JOINTS))
        self.register_buffer("size", vector(joint.friction for joint in JOINTS))
        self.viscous = nn.Parameter(torch.full((joints,), -2.0, dtype=torch.float64))
        shape = (joints, inputs, FRICTION_HIDDEN)
        weight = torch.randn(shape, dtype=torch.float64, generator=generator)
        self.weight = nn.Parameter(weight / inputs**0.5)
        self.bias = nn.Parameter(torch.zeros(joints, FRICTION_HIDDEN, dtype=torch.float64))
        self.out = nn.Parameter(torch.zeros(joints, FRICTION_HIDDEN, dtype=torch.float64))
        self.offset = nn.Parameter(torch.full((joints,), -2.0, dtype=torch.float64))

    def forward(self, q: Tensor, qd: Tensor) -> Tensor:
        """d, (..., n) [Nm s/rad, N s/m]: joint i is slowed by d_i qd_i."""
        smooth_speed = torch.sqrt(qd * qd + (SLOW * self.speed) ** 2)
        place = (q - self.center) / self.reach
        first = PLACE_SHARE * torch.where(self.revolute, q.cos(), place)
        second = PLACE_SHARE * torch.where(self.revolute, q.sin(), place)
        inputs = torch.stack([first, second, qd / self.speed, qd / smooth_speed], dim=-1)
        # joints are few and their networks small: sums of products beat batched matrix products
        hidden = torch.tanh((inputs.unsqueeze(-1) * self.weight).sum(dim=-2) + self.bias)
        dry = F.softplus((hidden * self.out).sum(dim=-1) + self.offset)
        return self.size * (F.softplus(self.viscous) / self.speed + dry / smooth_speed)


class Model(nn.Module):
    """The arm's dynamics: 3 learned functions of q and 2 constants make the mass matrix.

    Shapes: q, qd, qdd, tau and p are (..., n), with any leading dimensions. Units: rad and Nm for
    turning joints, m and N for sliding ones. M is positive definite and D positive semi-definite
    for all weights.
    """

    n: ClassVar[int] = 3
    joint_names: ClassVar[tuple[str, ...]] = tuple(joint.name for joint in JOINTS)
    joint_types: ClassVar[tuple[str, ...]] = tuple(
        "revolute" if joint.revolute else "prismatic" for joint in JOINTS
    )

    constant_scale: Tensor
    constant_basis: Tensor
    output_mean: Tensor
    output_scale: Tensor
    output_basis: Tensor
    mean_mass: Tensor
    whitening: Tensor
    whitening_rows: Tensor  # takes M, as a row, to its eigenproblem relative to its mean
    rotor_size: Tensor
    actuated: Tensor

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        start = vector(constant.start for constant in CONSTANTS)
        self.register_buffer("constant_scale", vector(constant.scale for constant in CONSTANTS))
        self.register_buffer("constant_basis", stacked([c.entries for c in CONSTANTS]))
        self.constants = nn.Parameter(start / self.constant_scale)
        self.register_buffer("output_mean", vector(output.mean for output in OUTPUTS))
        self.register_buffer("output_scale", vector(output.scale for output in OUTPUTS))
        self.register_buffer("output_basis", stacked([output.entries for output in OUTPUTS]))
        mean = start @ self.constant_basis + self.output_mean @ self.output_basis
        self.register_buffer("mean_mass", self._square(mean))
        self.register_buffer("whitening", torch.linalg.inv(torch.linalg.cholesky(self.mean_mass)))
        self.register_buffer("whitening_rows", torch.kron(self.whitening, self.whitening).mT)
        hidden = tuple(frozenset(joints) for joints, units in MASS_HIDDEN for _ in range(units))
        outputs = tuple(frozenset(output.joints) for output in OUTPUTS)
        read = tuple(sorted(frozenset().union(*outputs)))
        share = vector(joint.mass_share for joint in JOINTS)
        self.mass_network = Network(read, share, (*((hidden,) * MASS_DEPTH), outputs), generator)
        everything = frozenset(POTENTIAL_JOINTS)
        layers = (*((everything,) * width for width in POTENTIAL_HIDDEN), (everything,))
        share = vector(joint.potential_share for joint in JOINTS)
        self.potential_network = Network(POTENTIAL_JOINTS, share, layers, generator)
        self.friction = Friction(generator)
        self.register_buffer("rotor_size", vector(joint.rotor for joint in JOINTS))
        self.rotor = nn.Parameter(torch.zeros(self.n, dtype=torch.float64))
        self.register_buffer("actuated", vector(float(joint.actuated) for joint in JOINTS))

    def _rotors(self) -> Tensor:
        """What the drives add to M, (n, n), diagonal and never negative."""
        return torch.diag(self.rotor_size * self.rotor.exp())

    def _square(self, rows: Tensor) -> Tensor:
        """(..., n n) as (..., n, n)."""
        return rows.reshape(*rows.shape[:-1], self.n, self.n)

    def mass_matrix(self, q: Tensor) -> Tensor:
        """M(q), (..., n, n) [kg m^2, kg m, kg]."""
        return self._mass(q)[0]

    def _mass(self, q: Tensor) -> tuple[Tensor, Trace, Tensor | None]:
        """M(q), the network's trace and, where the guard is awake, its slope dl/dM, (..., n, n)."""
        y, trace = self.mass_network(q)
        outputs = self.output_mean + self.output_scale * y
        constants = (self.constant_scale * self.constants) @ self.constant_basis
        rows = constants + outputs @ self.output_basis
        relative = self._square(rows @ self.whitening_rows)
        if self._sound(relative):
            return self._square(rows) + self._rotors(), trace, None
        lift, slope = self._lift(relative)
        mass = self._square(rows) + lift[..., None, None] * self.mean_mass + self._rotors()
        return mass, trace, slope

    def _sound(self, relative: Tensor) -> bool:
        """Whether no eigenvalue of these matrices, (..., n, n), is below GUARD."""
        least = GUARD * torch.eye(self.n, dtype=relative.dtype, device=relative.device)
        return not torch.linalg.cholesky_ex(relative.detach() - least).info.any()

    def _lift(self, relative: Tensor) -> tuple[Tensor, Tensor]:
        """l >= 0 that makes M + l M_mean positive definite, (...), and dl/dM, (..., n, n).

        With e_i the eigenvalues of M relative to M_mean, and u_i = max(0, 1 - e_i / GUARD),
        l = GUARD sum_i u_i^5 / (1 + u_i^4). So every e_i + l stays above 0.43 GUARD, l is four
        times differentiable, and l = 0 where all e_i exceed GUARD. M_mean has M's own zeros and
        relations, which therefore hold in the sum.
        """
        values, vectors = torch.linalg.eigh(relative)
        u = F.relu(1 - values / GUARD)
        u4 = u**4
        slopes = -u4 * (5 + u4) / (1 + u4) ** 2
        slope = self.whitening.mT @ (vectors * slopes.unsqueeze(-2)) @ vectors.mT @ self.whitening
        return GUARD * (u * (u4 / (1 + u4))).sum(dim=-1), slope

    def _half_square_gradient(self, qd: Tensor, trace: Trace, slope: Tensor | None) -> Tensor:
        """d/dq of 1/2 qd^T M(q) qd, (..., n)."""
        weight = qd.unsqueeze(-1) * qd.unsqueeze(-2)
        if slope is not None:
            weight = weight + (weight * self.mean_mass).sum(dim=(-2, -1))[..., None, None] * slope
        cotangent = 0.5 * self.output_scale * (weight.flatten(-2) @ self.output_basis.mT)
        return self.mass_network.pull(trace, cotangent)

    def _mass_rate(self, qd: Tensor, trace: Trace, slope: Tensor | None) -> Tensor:
        """dM/dt along qd, (..., n, n)."""
        rates = self.output_scale * self.mass_network.push(trace, qd)
        rate = self._square(rates @ self.output_basis)
        if slope is not None:
            rate = rate + (slope * rate).sum(dim=(-2, -1))[..., None, None] * self.mean_mass
        return rate

    def potential_energy(self, q: Tensor) -> Tensor:
        """V(q), (...) [J]."""
        y: Tensor = self.potential_network(q)[0]
        return POTENTIAL_SCALE * y.squeeze(-1)

    def gravity(self, q: Tensor) -> Tensor:
        """dV/dq, (..., n) [Nm, N]."""
        y, trace = self.potential_network(q)
        return self.potential_network.pull(trace, POTENTIAL_SCALE * torch.ones_like(y))

    def dissipation(self, q: Tensor, qd: Tensor) -> Tensor:
        """D(q, qd), (..., n, n), diagonal: D qd is the friction torque."""
        return torch.diag_embed(self.friction(q, qd))

    def input_matrix(self, q: Tensor) -> Tensor:
        """G, (..., n, n): one for each actuated joint."""
        return torch.diag(self.actuated).expand(*q.shape[:-1], self.n, self.n)

    def momentum(self, q: Tensor, qd: Tensor) -> Tensor:
        """p = M(q) qd, (..., n)."""
        return (self.mass_matrix(q) @ qd.unsqueeze(-1)).squeeze(-1)

    def velocity(self, q: Tensor, p: Tensor) -> Tensor:
        """qd = M(q)^-1 p, (..., n)."""
        return self._solved(self.mass_matrix(q), p)

    @staticmethod
    def _solved(mass: Tensor, force: Tensor) -> Tensor:
        factor = torch.linalg.cholesky(mass)
        solution: Tensor = torch.cholesky_solve(force.unsqueeze(-1), factor)
        return solution.squeeze(-1)

    def hamiltonian(self, q: Tensor, p: Tensor) -> Tensor:
        """H = 1/2 p^T M(q)^-1 p + V(q), (...) [J]."""
        return 0.5 * (p * self.velocity(q, p)).sum(dim=-1) + self.potential_energy(q)

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor) -> Tensor:
        """qdd, (..., n), under the input tau."""
        mass, bias = self._mass_and_bias(q, qd)
        return self._solved(mass, self.actuated * tau - bias)

    def inverse_dynamics(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """The torque, (..., n), that gives qdd."""
        mass, bias = self._mass_and_bias(q, qd)
        return (mass @ qdd.unsqueeze(-1)).squeeze(-1) + bias

    def _mass_and_bias(self, q: Tensor, qd: Tensor) -> tuple[Tensor, Tensor]:
        """M and the torque that holds qd steady: dM/dt qd - d/dq (1/2 qd^T M qd) + dV/dq + D qd."""
        mass, trace, slope = self._mass(q)
        coriolis = (self._mass_rate(qd, trace, slope) @ qd.unsqueeze(-1)).squeeze(-1)
        coriolis = coriolis - self._half_square_gradient(qd, trace, slope)
        return mass, coriolis + self.gravity(q) + self.friction(q, qd) * qd

    def forward(self, t: Tensor, state: Tensor) -> Tensor:
        """The rate of (q, p), (..., 2 n), or of (q, p, tau), (..., 3 n), where tau is held.

        q' = dH/dp and p' = -dH/dq - D dH/dp + G tau: the port-Hamiltonian form (van der Schaft and
        Jeltsema, Port-Hamiltonian Systems Theory, 2014).
        """
        q, p, tau = state.tensor_split((self.n, 2 * self.n), dim=-1)
        mass, trace, slope = self._mass(q)
        qd = self._solved(mass, p)
        force = self._half_square_gradient(qd, trace, slope) - self.gravity(q)
        force = force - self.friction(q, qd) * qd
        if tau.shape[-1]:
            force = force + self.actuated * tau
        return torch.cat([qd, force, torch.zeros_like(tau)], dim=-1)

    def to_group(self, q: Tensor) -> list[Tensor]:
        """By joint, R in SO(3), (..., 3, 3), or r in R^3, (..., 3), if it slides; z is its axis."""
        parts = []
        for joint, value in zip(JOINTS, q.unbind(dim=-1), strict=True):
            zero, one = torch.zeros_like(value), torch.ones_like(value)
            if joint.revolute:
                c, s = value.cos(), value.sin()
                rows = ((c, -s, zero), (s, c, zero), (zero, zero, one))
                parts.append(torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2))
            else:
                parts.append(torch.stack((zero, zero, value), dim=-1))
        return parts

    def from_group(self, parts: list[Tensor]) -> Tensor:
        """q, (..., n), with angles in [-pi, pi]; the inverse of ``to_group``."""
        values = [
            torch.atan2(part[..., 1, 0], part[..., 0, 0]) if joint.revolute else part[..., 2]
            for joint, part in zip(JOINTS, parts, strict=True)
        ]
        return torch.stack(values, dim=-1)
