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

Record, by which `spelgen check` tells whether this module is up to date:

    robot: "rpr"
    urdf: "rpr.urdf"
    urdf_sha256: "aaacb65e5fa6a4caf626114ddf8869514f479b568dae43957e41214d3c6eff8d"
    spec_sha256: "433ae0e5dc62c042be455e649dd800c2947fd4eed322498f890111bbb4f8ae0e"
    option assume: "kinematics"
    option depth: 2
    option joints: null
    option net: "mlp"
    option preset: "phnode"
    option snap_tolerance: 0.002
    option tip: null
    option width: 64
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import partial
from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn


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

# nominal mean of M without rotors, its lower triangle row by row
MEAN_MASS = ((139.887,), (-0.00167665, 5.33), (-0.00154309, 0.0, 0.0101411))
MASS_WIDTH = 64  # units in a hidden layer
POTENTIAL_JOINTS = (0, 1, 2)  # the joints that V depends on
POTENTIAL_WIDTH = 32
POTENTIAL_SCALE = 0.703291  # [J]
DEPTH = 2  # hidden layers of a network
FRICTION_AXES = 3  # of each joint, z the last
FRICTION_WIDTH = 64
FRICTION_START = 0.35  # diagonal of D's factor, relative to the joints' usual friction
PLACE_SHARE = 0.1  # how much friction's networks see of where a joint is, relative to its speed
INPUT_WIDTH = 64


def vector(values: Iterable[float]) -> Tensor:
    """The values as a float64 tensor."""
    return torch.tensor(list(values), dtype=torch.float64)


def mean_factor() -> Tensor:
    """C, lower triangular: C C^T is the nominal mean of M^-1 over all axes, (3 n, 3 n).

    z of each joint moves; about its other axes a joint is taken to be as heavy as about z.
    """
    n = len(JOINTS)
    mean = torch.zeros(n, n, dtype=torch.float64)
    row, column = torch.tril_indices(n, n)
    mean[row, column] = mean[column, row] = vector(x for entries in MEAN_MASS for x in entries)
    mean += torch.diag(vector(joint.rotor for joint in JOINTS))
    everywhere = torch.diag(mean.diagonal().repeat_interleave(3))
    everywhere[2::3, 2::3] = mean
    factor: Tensor = torch.linalg.cholesky(torch.linalg.inv(everywhere))
    return factor


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


Trace = tuple[tuple[Tensor, ...], Layers]


def by_sigmoid(rate: Tensor, value: Tensor) -> Tensor:
    """rate * value (1 - value), the sigmoid's slope, in one pass: memory is what takes the time."""
    changed: Tensor = torch.ops.aten.sigmoid_backward(rate, value)
    return changed


class Network(nn.Module):
    """A tanh network, with its derivatives written out.

    ``layers`` names, unit by unit, the joints that each layer's units may read; weights between
    others are masked, so that a unit has no path to a joint it must not depend on.
    """

    spread: Tensor
    fixed: Tensor

    def __init__(
        self,
        reading: Reading,
        layers: tuple[tuple[frozenset[int], ...], ...],
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.register_buffer("spread", reading.spread)
        self.register_buffer("fixed", reading.fixed)
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        below = tuple(frozenset((joint,)) for joint in reading.joints)
        for index, units in enumerate(layers):
            allowed = [[float(lower <= upper) for lower in below] for upper in units]
            mask = torch.tensor(allowed, dtype=torch.float64)
            weight = torch.randn(mask.shape, dtype=torch.float64, generator=generator)
            self.weights.append(nn.Parameter(weight / mask.sum(dim=1, keepdim=True).sqrt()))
            self.register_buffer(f"mask{index}", mask * reading.share if index == 0 else mask)
            self.biases.append(nn.Parameter(torch.zeros(len(units), dtype=torch.float64)))
            below = units
        nn.init.zeros_(self.weights[-1])  # so that the model starts at its nominal means

    def prepared(self, outlay: Tensor, offset: Tensor) -> Layers:
        """The weights for the features as they are, and for offset + outlay y in place of y.

        tanh x is computed as 2 sigmoid(2 x) - 1, which takes a fraction of the time.
        """
        weights, biases = [], []
        for index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            weight = weight * self.get_buffer(f"mask{index}")
            if index == 0:
                bias = bias + weight @ self.fixed
                weight = weight @ self.spread
            else:
                bias, weight = bias - weight.sum(dim=1), 2 * weight
            weights.append(2 * weight)
            biases.append(2 * bias)
        weights[-1] = 0.5 * outlay @ weights[-1]
        biases[-1] = offset + 0.5 * outlay @ biases[-1]
        return Layers(tuple(weights), tuple(biases))

    def forward(self, features: Tensor, layers: Layers) -> tuple[Tensor, Trace]:
        """y laid out, (..., rows); and what ``pull`` and ``push`` need."""
        layer, hidden = features, []
        for weight, bias in zip(layers.weights[:-1], layers.biases, strict=False):
            layer = torch.sigmoid(F.linear(layer, weight, bias))
            hidden.append(layer)
        return F.linear(layer, layers.weights[-1], layers.biases[-1]), (tuple(hidden), layers)

    def pull(self, trace: Trace, cotangent: Tensor) -> Tensor:
        """The reverse sweep: cotangent, (..., rows), times dy/dfeatures; (..., features)."""
        hidden, layers = trace
        layer = cotangent @ layers.weights[-1]
        for weight, value in zip(reversed(layers.weights[:-1]), reversed(hidden), strict=True):
            layer = by_sigmoid(layer, value) @ weight
        return layer

    def push(self, trace: Trace, rate: Tensor) -> Tensor:
        """The forward sweep: dy/dfeatures times the features' rate; (..., rows)."""
        hidden, layers = trace
        for weight, value in zip(layers.weights[:-1], hidden, strict=True):
            rate = by_sigmoid(F.linear(rate, weight), value)
        return F.linear(rate, layers.weights[-1])


class Friction(nn.Module):
    """D = L L^T, of all q and qd: a network gives L, over all three axes of every joint.

    A joint moves along z alone, so only the rows of L that are z axes are worked out.
    """

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
    potential: Layers
    friction: Layers
    input: Layers


# what M's derivatives need of the work done for M
Memory = tuple[Trace, Tensor, Tensor, Tensor]


class Model(nn.Module):
    """The arm's dynamics: 45 learned functions of q make M^-1 over all axes.

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
    mean_factor: Tensor
    moving: Tensor
    below: Tensor  # where the entries below U's diagonal stand in U, row by row
    mass_start: Tensor
    input_outlay: Tensor

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.register_buffer("center", vector(joint.center for joint in JOINTS))
        self.register_buffer("reach", vector(joint.reach for joint in JOINTS))
        everything = frozenset(range(self.n))
        factor, size = mean_factor(), 3 * self.n
        self.register_buffer("mean_factor", factor)
        self.register_buffer("moving", torch.linalg.inv(factor)[:, 2::3])
        row, column = torch.tril_indices(size, size, -1)
        self.register_buffer("below", row * size + column)
        # so that U starts without entries below its diagonal, and e at one
        start = vector([0.0] * len(row) + [math.log(math.e - 1)] * size)
        self.register_buffer("mass_start", start)
        layers = (*(((everything,) * MASS_WIDTH,) * DEPTH), (everything,) * len(start))
        shares = [joint.mass_share for joint in JOINTS]
        self.mass_network = Network(reading(shares), layers, generator)
        layers = (*(((everything,) * POTENTIAL_WIDTH,) * DEPTH), (everything,))
        shares = [joint.potential_share for joint in JOINTS]
        self.potential_network = Network(reading(shares), layers, generator)
        self.friction = Friction(generator)
        self.register_buffer("input_outlay", torch.eye(3 * self.n, dtype=torch.float64)[2::3])
        layers = (*(((everything,) * INPUT_WIDTH,) * DEPTH), (everything,) * (3 * self.n))
        self.input_network = Network(reading([1.0] * self.n), layers, generator)

    def prepare(self) -> Prepared:
        """All that depends on the weights alone; holds until they change."""
        scale = self.friction.size.new_full((1, 1), POTENTIAL_SCALE)
        return Prepared(
            mass=self.mass_network.prepared(torch.diag(0 * self.mass_start + 1), self.mass_start),
            potential=self.potential_network.prepared(scale, 0 * scale[0]),
            friction=self.friction.prepared(),
            input=self.input_network.prepared(self.input_outlay, self.input_outlay.sum(dim=1)),
        )

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

    def axes_inverse_mass(self, q: Tensor) -> Tensor:
        """M(q)^-1 over all three axes of every joint, of which z moves; (..., 3 n, 3 n).

        M^-1 = C U diag(e) U^T C^T, with C the Cholesky factor of the nominal mean, U lower
        triangular with ones on its diagonal and e > 0: the Cholesky factorisation in its form
        without square roots.
        """
        raw, _ = self.mass_network(self._features(q), self.prepare().mass)
        factor, scale = self._factor(raw)
        lower = self.mean_factor @ (factor + torch.eye(3 * self.n).to(q))
        return (lower * scale.unsqueeze(-2)) @ lower.mT

    def _factor(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        """U, below its diagonal of ones, (..., 3 n, 3 n), and e, (..., 3 n)."""
        entries, scale = raw.tensor_split((len(self.below),), dim=-1)
        return self._lower(entries), F.softplus(scale)

    def _lower(self, entries: Tensor) -> Tensor:
        """The matrix, (..., 3 n, 3 n), with these entries below its diagonal, row by row."""
        size = 3 * self.n
        rows = entries.new_zeros(*entries.shape[:-1], size * size)
        return rows.index_copy(-1, self.below, entries).reshape(*entries.shape[:-1], size, size)

    @staticmethod
    def _unit_solved(factor: Tensor, right: Tensor, upper: bool = False) -> Tensor:
        solution: Tensor = torch.linalg.solve_triangular(
            factor, right, upper=upper, unitriangular=True
        )
        return solution

    def _mass(self, features: Tensor, prepared: Prepared) -> tuple[Tensor, Memory]:
        """M(q) of the moving axes, (..., n, n); the network's trace, U, U^-1 A and e.

        The bearings hold the other axes still, so M is the moving block of M over all axes:
        (U^-1 A)^T diag(1 / e) U^-1 A, where A is the moving columns of C^-1.
        """
        raw, trace = self.mass_network(features, prepared.mass)
        factor, scale = self._factor(raw)
        moved = self._unit_solved(factor, self.moving)
        return moved.mT @ (moved / scale.unsqueeze(-1)), (trace, factor, moved, scale)

    def _kinetic_slope(self, qd: Tensor, memory: Memory) -> Tensor:
        """d/dfeatures of 1/2 qd^T M(q) qd, (..., features)."""
        trace, factor, moved, scale = memory
        speed = moved @ qd.unsqueeze(-1)
        momentum = speed / scale.unsqueeze(-1)
        by_factor = -self._unit_solved(factor.mT, momentum, upper=True) @ speed.mT
        by_entry = by_factor.flatten(-2).index_select(-1, self.below)
        by_scale = 0.5 * momentum.squeeze(-1) ** 2 * torch.expm1(-scale)
        return self.mass_network.pull(trace, torch.cat([by_entry, by_scale], dim=-1))

    def _mass_rate(self, rate: Tensor, memory: Memory) -> Tensor:
        """dM/dt where the features change at this rate, (..., n, n)."""
        trace, factor, moved, scale = memory
        pushed = self.mass_network.push(trace, rate)
        entries, raw_rate = pushed.tensor_split((len(self.below),), dim=-1)
        turned = self._unit_solved(factor, self._lower(entries) @ moved)
        by_factor = moved.mT @ (turned / scale.unsqueeze(-1))
        by_scale = raw_rate * torch.expm1(-scale) / scale**2
        return moved.mT @ (moved * by_scale.unsqueeze(-1)) - by_factor - by_factor.mT

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
        """G(q), (..., n, n), diagonal: the moving axis of each joint's column of three."""
        return torch.diag_embed(self._gains(self._features(q), self.prepare()))

    def _gains(self, features: Tensor, prepared: Prepared) -> Tensor:
        gains: Tensor = self.input_network(features, prepared.input)[0]
        return gains

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
        return self._solved(mass, self._gains(features, prepared) * tau - bias)

    def inverse_dynamics(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """The torque, (..., n), that gives qdd."""
        prepared, features = self.prepare(), self._features(q)
        mass, bias = self._mass_and_bias(features, qd, prepared)
        force = (mass @ qdd.unsqueeze(-1)).squeeze(-1) + bias
        return force / self._gains(features, prepared)

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
            force = force + self._gains(features, prepared) * tau
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
