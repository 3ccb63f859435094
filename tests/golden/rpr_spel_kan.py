r"""Port-Hamiltonian model of an arm with 3 joints, written by `spelgen build`.

3 learned functions of q and 2 constants make the mass matrix.
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

Record, by which `spelgen check` tells whether this module is up to date:

    robot: "rpr"
    urdf: "rpr.urdf"
    urdf_sha256: "aaacb65e5fa6a4caf626114ddf8869514f479b568dae43957e41214d3c6eff8d"
    spec_sha256: "ef925c469ce00d9a6704cd3cb668df30bf6257fd7358ecf1e200a448cf071049"
    option assume: "kinematics"
    option depth: 2
    option joints: null
    option net: "kan"
    option preset: "spel-kan"
    option snap_tolerance: 0.002
    option tip: null
    option width: 64
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
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
    Output(joints=(0, 1, 2), mean=-0.00167665, scale=1.36528, entries=((1, 0, 1.0),)),
    Output(joints=(0, 1, 2), mean=-0.00154309, scale=0.0595527, entries=((2, 0, 1.0),)),
    Output(joints=(0, 1, 2), mean=139.887, scale=12.6351, entries=((0, 0, 1.0),)),
)
# in each hidden layer: the joints that some units read, and how many units do
MASS_HIDDEN = (((0, 1, 2), 16),)
GUARD = 0.08  # least eigenvalue of M, relative to its nominal mean, that is left as it is
POTENTIAL_JOINTS = (0, 1, 2)  # the joints that V depends on
POTENTIAL_WIDTH = 8
POTENTIAL_SCALE = 0.703291  # [J]
DEPTH = 2  # hidden layers of a network
GRID = 4  # bumps on an edge
SPACING = 2 / (GRID - 1)
FRICTION_AXES = 1  # of each joint, z the last
FRICTION_WIDTH = 16
FRICTION_START = 0.35  # diagonal of D's factor, relative to the joints' usual friction
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


def lower_entries(rows: int) -> Tensor:
    """Spreads the numbers of a lower triangle, row by row, over a matrix: (rows, rows, numbers)."""
    row, column = torch.tril_indices(rows, rows)
    spread = torch.zeros(rows, rows, len(row), dtype=torch.float64)
    spread[row, column, torch.arange(len(row))] = 1.0
    return spread


class Reading(NamedTuple):
    """The inputs of a network: share * (spread features + fixed), (inputs, ...)."""

    joints: tuple[int, ...]  # whose each input is
    share: Tensor
    spread: Tensor  # (inputs, features)
    fixed: Tensor


def reading(shares: list[float], axes: int = 0) -> Reading:
    """Of each joint the nine numbers of R in SO(3) or the three of r in R^3, times its share.

    z is the joint's axis, so R = [[cos q, -sin q, 0], [sin q, cos q, 0], [0, 0, 1]]. Then, with
    ``axes``, each joint's velocity along so many axes, of which the last is z.
    """
    n, zeros = len(JOINTS), partial(torch.zeros, dtype=torch.float64)
    width = 3 * n + n * (axes > 0)
    joints, share, spread, fixed = [], [], [], []
    for i, joint in enumerate(JOINTS):
        size = 9 if joint.revolute else 3
        block, rest = zeros(size, width), zeros(size)
        if joint.revolute:
            block[[0, 4], i], rest[8] = 1.0, 1.0
            block[[1, 3], n + i] = vector((-1.0, 1.0))
        else:
            block[2, 2 * n + i] = 1.0
        joints += [i] * size
        share += [shares[i]] * size
        spread.append(block)
        fixed.append(rest)
    for i in range(n if axes else 0):
        block = zeros(axes, width)
        block[-1, 3 * n + i] = 1.0
        joints += [i] * axes
        share += [1.0] * axes
        spread.append(block)
        fixed.append(zeros(axes))
    return Reading(tuple(joints), vector(share), torch.cat(spread), torch.cat(fixed))


class Layers(NamedTuple):
    """A network's weights made ready for many states; see ``Network.prepared``."""

    weights: tuple[Tensor, ...]
    biases: tuple[Tensor, ...]


class Bumps(NamedTuple):
    """A layer's inputs as the grid sees them, (..., inputs, GRID)."""

    place: Tensor  # distance from each grid point, in grid spacings
    height: Tensor


Trace = tuple[tuple[Bumps, ...], tuple[Tensor, ...], Layers]


class Network(nn.Module):
    """A Kolmogorov-Arnold network, with its derivatives written out.

    Each edge from an input to a unit has a learned function of its own: a sum of Gaussian bumps on
    a grid over [-1, 1] (Li, arXiv 2405.06721, in place of the splines of Liu et al., arXiv
    2404.19756). It starts nearly straight, with a random slope: few samples do not smooth what
    starts wavy. tanh keeps what a layer hands on within the grid. ``layers`` names, unit by unit,
    the joints that each layer's units may read; edges between others are masked, so that a unit
    has no path to a joint it must not depend on.
    """

    spread: Tensor
    fixed: Tensor
    grid: Tensor

    def __init__(
        self,
        reading: Reading,
        layers: tuple[tuple[frozenset[int], ...], ...],
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        grid = torch.linspace(-1, 1, GRID, dtype=torch.float64)
        self.register_buffer("grid", grid / SPACING)
        each = torch.eye(GRID, dtype=torch.float64)
        # the bumps of -x are those of x in reverse
        forth, back = reading.spread.clamp(min=0), (-reading.spread).clamp(min=0)
        self.register_buffer("spread", torch.kron(forth, each) + torch.kron(back, each.flip(0)))
        still = 1 - reading.spread.abs().sum(dim=1, keepdim=True)
        self.register_buffer("fixed", (still * self._bumps(reading.fixed).height).flatten())
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        below = tuple(frozenset((joint,)) for joint in reading.joints)
        for index, units in enumerate(layers):
            allowed = [[[float(lower <= upper)] for lower in below] for upper in units]
            mask = torch.tensor(allowed, dtype=torch.float64)
            slope = torch.randn(mask.shape, dtype=torch.float64, generator=generator)
            self.weights.append(nn.Parameter(slope * grid / mask.sum(dim=1, keepdim=True).sqrt()))
            if index == 0:
                mask = mask * reading.share.unsqueeze(-1)
            self.register_buffer(f"mask{index}", mask)
            self.biases.append(nn.Parameter(torch.zeros(len(units), dtype=torch.float64)))
            below = units
        nn.init.zeros_(self.weights[-1])  # so that the model starts at its nominal means

    def prepared(self, outlay: Tensor, offset: Tensor) -> Layers:
        """The weights for the features as they are, and for offset + outlay y in place of y."""
        weights = [(w * self.get_buffer(f"mask{i}")).flatten(1) for i, w in enumerate(self.weights)]
        biases = list(self.biases)
        biases[0] = biases[0] + weights[0] @ self.fixed
        weights[0] = weights[0] @ self.spread
        weights[-1], biases[-1] = outlay @ weights[-1], offset + outlay @ biases[-1]
        return Layers(tuple(weights), tuple(biases))

    def _bumps(self, value: Tensor) -> Bumps:
        place = (value / SPACING).unsqueeze(-1) - self.grid
        return Bumps(place, torch.exp(-place * place))

    def forward(self, features: Tensor, layers: Layers) -> tuple[Tensor, Trace]:
        """y laid out, (..., rows); and what ``pull`` and ``push`` need."""
        bumps, hidden = [self._bumps(features)], []
        for weight, bias in zip(layers.weights[:-1], layers.biases, strict=False):
            hidden.append(torch.tanh(F.linear(bumps[-1].height.flatten(-2), weight, bias)))
            bumps.append(self._bumps(hidden[-1]))
        y = F.linear(bumps[-1].height.flatten(-2), layers.weights[-1], layers.biases[-1])
        return y, (tuple(bumps), tuple(hidden), layers)

    def pull(self, trace: Trace, cotangent: Tensor) -> Tensor:
        """The reverse sweep: cotangent, (..., rows), times dy/dfeatures; (..., features)."""
        bumps, hidden, layers = trace
        layer = self._pulled(bumps[-1], cotangent @ layers.weights[-1])
        for index in reversed(range(len(hidden))):
            layer = layer * (1 - hidden[index] * hidden[index])
            layer = self._pulled(bumps[index], layer @ layers.weights[index])
        return layer

    def _pulled(self, bumps: Bumps, cotangent: Tensor) -> Tensor:
        cotangent = cotangent.reshape(*cotangent.shape[:-1], *bumps.place.shape[-2:])
        return (-2 / SPACING) * (bumps.place * bumps.height * cotangent).sum(dim=-1)

    def push(self, trace: Trace, rate: Tensor) -> Tensor:
        """The forward sweep: dy/dfeatures times the features' rate; (..., rows)."""
        bumps, hidden, layers = trace
        for index, weight in enumerate(layers.weights):
            slopes = bumps[index].place * bumps[index].height
            pushed = (-2 / SPACING) * (slopes * rate.unsqueeze(-1)).flatten(-2)
            rate = F.linear(pushed, weight)
            if index < len(hidden):
                rate = rate * (1 - hidden[index] * hidden[index])
        return rate


class Friction(nn.Module):
    """D = L L^T, of all q and qd: a network gives L, with a row and a column for each joint."""

    speed: Tensor
    size: Tensor
    outlay: Tensor
    start: Tensor

    def __init__(self, generator: torch.Generator) -> None:
        super().__init__()
        n, rows = len(JOINTS), FRICTION_AXES * len(JOINTS)
        self.register_buffer("speed", vector(joint.speed for joint in JOINTS))
        self.register_buffer("size", vector(joint.friction for joint in JOINTS))
        moving = slice(FRICTION_AXES - 1, None, FRICTION_AXES)
        entries = lower_entries(rows)
        self.register_buffer("outlay", entries[moving])
        self.register_buffer("start", FRICTION_START * torch.eye(rows, dtype=torch.float64)[moving])
        everything = frozenset(range(n))
        layers = (*(((everything,) * FRICTION_WIDTH,) * DEPTH), (everything,) * entries.shape[-1])
        self.network = Network(reading([PLACE_SHARE] * n, FRICTION_AXES), layers, generator)

    def prepared(self) -> Layers:
        """The network's weights made ready for many states."""
        size = torch.sqrt(self.size / self.speed).unsqueeze(-1)
        outlay = (size.unsqueeze(-1) * self.outlay).flatten(0, 1)
        return self.network.prepared(outlay, (size * self.start).flatten())

    def _factor(self, features: Tensor, qd: Tensor, layers: Layers) -> Tensor:
        rows: Tensor = self.network(torch.cat([features, qd / self.speed], dim=-1), layers)[0]
        return rows.reshape(*qd.shape[:-1], *self.start.shape)

    def forward(self, features: Tensor, qd: Tensor, layers: Layers) -> Tensor:
        """The friction torque D qd, (..., n) [Nm, N]."""
        factor = self._factor(features, qd, layers)
        return (factor @ (factor.mT @ qd.unsqueeze(-1))).squeeze(-1)

    def matrix(self, features: Tensor, qd: Tensor, layers: Layers) -> Tensor:
        """D, (..., n, n)."""
        factor = self._factor(features, qd, layers)
        return factor @ factor.mT


class Prepared(NamedTuple):
    """What depends on the weights alone, worked out once for many states."""

    mass: Layers
    rotors: Tensor
    least: Tensor  # M above this needs no guard
    potential: Layers
    friction: Layers


# what M's derivatives need of the work done for M
Memory = tuple[Trace, Tensor | None]


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

    center: Tensor
    reach: Tensor
    constant_scale: Tensor
    constant_basis: Tensor
    output_mean: Tensor
    output_scale: Tensor
    output_basis: Tensor
    mean_mass: Tensor
    whitening: Tensor  # takes M to its eigenproblem relative to its mean
    rotor_size: Tensor
    actuated: Tensor

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.register_buffer("center", vector(joint.center for joint in JOINTS))
        self.register_buffer("reach", vector(joint.reach for joint in JOINTS))
        everything = frozenset(range(self.n))
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
        hidden = tuple(frozenset(joints) for joints, units in MASS_HIDDEN for _ in range(units))
        outputs = tuple(frozenset(output.joints) for output in OUTPUTS)
        shares = [joint.mass_share for joint in JOINTS]
        layers = (*((hidden,) * DEPTH), outputs)
        self.mass_network = Network(reading(shares), layers, generator)
        layers = (*(((everything,) * POTENTIAL_WIDTH,) * DEPTH), (everything,))
        shares = [joint.potential_share for joint in JOINTS]
        self.potential_network = Network(reading(shares), layers, generator)
        self.friction = Friction(generator)
        self.register_buffer("rotor_size", vector(joint.rotor for joint in JOINTS))
        self.rotor = nn.Parameter(torch.zeros(self.n, dtype=torch.float64))
        self.register_buffer("actuated", vector(float(joint.actuated) for joint in JOINTS))

    def prepare(self) -> Prepared:
        """All that depends on the weights alone; holds until they change."""
        rotors = torch.diag(self.rotor_size * self.rotor.exp())  # diagonal and never negative
        constant = (self.constant_scale * self.constants) @ self.constant_basis
        constant = constant + self.output_mean @ self.output_basis + rotors.flatten()
        outlay = (self.output_scale.unsqueeze(-1) * self.output_basis).mT
        scale = self.friction.size.new_full((1, 1), POTENTIAL_SCALE)
        return Prepared(
            mass=self.mass_network.prepared(outlay, constant),
            rotors=rotors,
            least=(rotors + GUARD * self.mean_mass).detach(),
            potential=self.potential_network.prepared(scale, 0 * scale[0]),
            friction=self.friction.prepared(),
        )

    def _square(self, rows: Tensor) -> Tensor:
        """(..., n n) as (..., n, n)."""
        return rows.reshape(*rows.shape[:-1], self.n, self.n)

    def _features(self, q: Tensor) -> Tensor:
        """cos q, sin q, the scaled q: all that is read of q, (..., 3 n)."""
        place = (q - self.center) / self.reach
        return torch.cat([q.cos(), q.sin(), place], dim=-1)

    def _features_rate(self, features: Tensor, qd: Tensor) -> Tensor:
        """How fast the features change along qd."""
        cos, sin, _ = features.chunk(3, dim=-1)
        return torch.cat([-sin * qd, cos * qd, qd / self.reach], dim=-1)

    def _by_joint(self, features: Tensor, slope: Tensor) -> Tensor:
        """d/dq, (..., n), of what has this slope by features."""
        cos, sin, _ = features.chunk(3, dim=-1)
        by_cos, by_sin, by_place = slope.chunk(3, dim=-1)
        return by_sin * cos - by_cos * sin + by_place / self.reach

    def mass_matrix(self, q: Tensor, prepared: Prepared | None = None) -> Tensor:
        """M(q), (..., n, n) [kg m^2, kg m, kg]; with what ``prepare`` gave, where it is at hand."""
        return self._mass(self._features(q), prepared or self.prepare())[0]

    def _mass(self, features: Tensor, prepared: Prepared) -> tuple[Tensor, Memory]:
        """M(q), the network's trace and, where the guard is awake, its slope dl/dM, (..., n, n)."""
        rows, trace = self.mass_network(features, prepared.mass)
        mass = self._square(rows)
        if self._sound(mass, prepared):
            return mass, (trace, None)
        lift, slope = self._lift(mass - prepared.rotors)
        return mass + lift[..., None, None] * self.mean_mass, (trace, slope)

    def _sound(self, mass: Tensor, prepared: Prepared) -> bool:
        """Whether no eigenvalue of M less rotors, relative to its mean, is below GUARD."""
        return not torch.linalg.cholesky_ex(mass.detach() - prepared.least).info.any()

    def _lift(self, mass: Tensor) -> tuple[Tensor, Tensor]:
        """l >= 0 that makes M + l M_mean positive definite, (...), and dl/dM, (..., n, n).

        With e_i the eigenvalues of M relative to M_mean, and u_i = max(0, 1 - e_i / GUARD),
        l = GUARD sum_i u_i^5 / (1 + u_i^4). So every e_i + l stays above 0.43 GUARD, l is four
        times differentiable, and l = 0 where all e_i exceed GUARD. M_mean has M's own zeros and
        relations, which therefore hold in the sum.
        """
        values, vectors = torch.linalg.eigh(self.whitening @ mass @ self.whitening.mT)
        u = F.relu(1 - values / GUARD)
        u4 = u**4
        slopes = -u4 * (5 + u4) / (1 + u4) ** 2
        slope = self.whitening.mT @ (vectors * slopes.unsqueeze(-2)) @ vectors.mT @ self.whitening
        return GUARD * (u * (u4 / (1 + u4))).sum(dim=-1), slope

    def _kinetic_slope(self, qd: Tensor, memory: Memory) -> Tensor:
        """d/dfeatures of 1/2 qd^T M(q) qd, (..., features)."""
        trace, slope = memory
        weight = (0.5 * qd).unsqueeze(-1) * qd.unsqueeze(-2)
        if slope is not None:
            weight = weight + (weight * self.mean_mass).sum(dim=(-2, -1))[..., None, None] * slope
        return self.mass_network.pull(trace, weight.flatten(-2))

    def _mass_rate(self, rate: Tensor, memory: Memory) -> Tensor:
        """dM/dt where the features change at this rate, (..., n, n)."""
        trace, slope = memory
        mass_rate = self._square(self.mass_network.push(trace, rate))
        if slope is not None:
            along = (slope * mass_rate).sum(dim=(-2, -1))[..., None, None]
            mass_rate = mass_rate + along * self.mean_mass
        return mass_rate

    def potential_energy(self, q: Tensor) -> Tensor:
        """V(q), (...) [J]."""
        y: Tensor = self.potential_network(self._features(q), self.prepare().potential)[0]
        return y.squeeze(-1)

    def gravity(self, q: Tensor) -> Tensor:
        """dV/dq, (..., n) [Nm, N]."""
        features = self._features(q)
        return self._by_joint(features, self._potential_slope(features, self.prepare()))

    def _potential_slope(self, features: Tensor, prepared: Prepared) -> Tensor:
        """d/dfeatures of V, (..., features)."""
        _, trace = self.potential_network(features, prepared.potential)
        return self.potential_network.pull(trace, features.new_ones(1))

    def dissipation(self, q: Tensor, qd: Tensor) -> Tensor:
        """D(q, qd), (..., n, n): D qd is the friction torque."""
        return self.friction.matrix(self._features(q), qd, self.prepare().friction)

    def input_matrix(self, q: Tensor) -> Tensor:
        """G, (..., n, n): one for each actuated joint."""
        return torch.diag(self.actuated).expand(*q.shape[:-1], self.n, self.n)

    def momentum(self, q: Tensor, qd: Tensor, prepared: Prepared | None = None) -> Tensor:
        """p = M(q) qd, (..., n)."""
        return (self.mass_matrix(q, prepared) @ qd.unsqueeze(-1)).squeeze(-1)

    def velocity(self, q: Tensor, p: Tensor, prepared: Prepared | None = None) -> Tensor:
        """qd = M(q)^-1 p, (..., n)."""
        return self._solved(self.mass_matrix(q, prepared), p)

    @staticmethod
    def _solved(mass: Tensor, force: Tensor) -> Tensor:
        # its derivative costs one more solution; a Cholesky factor's would cost several times that
        solution: Tensor = torch.linalg.solve(mass, force.unsqueeze(-1))
        return solution.squeeze(-1)

    def hamiltonian(self, q: Tensor, p: Tensor) -> Tensor:
        """H = 1/2 p^T M(q)^-1 p + V(q), (...) [J]."""
        return 0.5 * (p * self.velocity(q, p)).sum(dim=-1) + self.potential_energy(q)

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor) -> Tensor:
        """qdd, (..., n), under the input tau."""
        prepared, features = self.prepare(), self._features(q)
        mass, bias = self._mass_and_bias(features, qd, prepared)
        return self._solved(mass, self.actuated * tau - bias)

    def inverse_dynamics(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """The torque, (..., n), that gives qdd."""
        mass, bias = self._mass_and_bias(self._features(q), qd, self.prepare())
        return (mass @ qdd.unsqueeze(-1)).squeeze(-1) + bias

    def _mass_and_bias(
        self, features: Tensor, qd: Tensor, prepared: Prepared
    ) -> tuple[Tensor, Tensor]:
        """M and the torque that holds qd steady: dM/dt qd - d/dq (1/2 qd^T M qd) + dV/dq + D qd."""
        mass, memory = self._mass(features, prepared)
        mass_rate = self._mass_rate(self._features_rate(features, qd), memory)
        bias = (mass_rate @ qd.unsqueeze(-1)).squeeze(-1)
        bias = bias - self._lagrangian_slope(features, qd, memory, prepared)
        return mass, bias + self.friction(features, qd, prepared.friction)

    def _lagrangian_slope(
        self, features: Tensor, qd: Tensor, memory: Memory, prepared: Prepared
    ) -> Tensor:
        """d/dq of 1/2 qd^T M(q) qd - V(q), (..., n)."""
        slope = self._kinetic_slope(qd, memory) - self._potential_slope(features, prepared)
        return self._by_joint(features, slope)

    def forward(self, t: Tensor, state: Tensor) -> Tensor:
        """The rate of (q, p), (..., 2 n), or of (q, p, tau), (..., 3 n), where tau is held."""
        q, p, tau = state.tensor_split((self.n, 2 * self.n), dim=-1)
        qd, force = self.rates(q, p, tau if tau.shape[-1] else None, self.prepare())
        return torch.cat([qd, force, torch.zeros_like(tau)], dim=-1)

    def rates(
        self, q: Tensor, p: Tensor, tau: Tensor | None, prepared: Prepared
    ) -> tuple[Tensor, Tensor]:
        """q' and p', (..., n), under the input tau, with what ``prepare`` gave.

        q' = dH/dp and p' = -dH/dq - D dH/dp + G tau: the port-Hamiltonian form (van der Schaft and
        Jeltsema, Port-Hamiltonian Systems Theory, 2014).
        """
        features = self._features(q)
        mass, memory = self._mass(features, prepared)
        qd = self._solved(mass, p)
        force = self._lagrangian_slope(features, qd, memory, prepared)
        force = force - self.friction(features, qd, prepared.friction)
        if tau is not None:
            force = force + self.actuated * tau
        return qd, force

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
