r"""Port-Hamiltonian model of an arm with 2 joints, written by `spelgen build`.

1 learned function of q and 2 constants make the mass matrix.
The potential energy depends on joints 1,2.
M and V: sums of waves with trained factors, and a part for a network.
Sizes and starting values are the URDF's inertials.

Mass matrix: the joints each entry depends on, C where it is constant, . where it is always zero.

    2
    2   C

Joints, in the order of q, qd and tau:

    1  "joint1"  revolute   rad, Nm  -3.14159 .. 3.14159
    2  "joint2"  revolute   rad, Nm  -3.14159 .. 3.14159

Record, by which `spelgen check` tells whether this module is up to date:

    robot: "two_link"
    urdf: "two_link.urdf"
    urdf_sha256: "d5393c842e189b72219c5ce02e115de571a94cd406b48898ea64b5431a395232"
    spec_sha256: "a9423f1a66b0c567ee978db84edfb3e3253f35817a7f8976afa1c10b85cb31a4"
    option assume: "kinematics"
    option depth: 2
    option joints: null
    option net: "mlp"
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
# a sum of waves: number of the wave, factor of its cosine, factor of its sine, to start from
Terms = tuple[tuple[int, float, float], ...]


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
    """A learned function f of some joints, which enters M as f B: a sum of waves and a network.

    f = level + sum of terms + NETWORK_SHARE * scale * network; mean is f's over the workspace.
    """

    joints: tuple[int, ...]
    mean: float
    scale: float
    level: float
    terms: Terms
    entries: Entries  # of B


class Wave(NamedTuple):
    """cos(turns q) and sin(turns q)."""

    turns: tuple[int, ...]


JOINTS = (
    Joint(
        name="joint1",
        revolute=True,
        center=0.0,
        reach=3.14159,
        speed=10.0,
        friction=1.0,
        rotor=0.1,
        mass_share=0.02,
        potential_share=1.0,
        actuated=True,
    ),
    Joint(
        name="joint2",
        revolute=True,
        center=0.0,
        reach=3.14159,
        speed=10.0,
        friction=1.0,
        rotor=0.1,
        mass_share=1.0,
        potential_share=0.307,
        actuated=True,
    ),
)

# what M and V of a rigid arm are made of, whatever its masses are
WAVES = (Wave(turns=(0, 1)), Wave(turns=(1, 0)), Wave(turns=(1, 1)))
NETWORK_SHARE = 0.1  # how much of a function that is a sum of waves is left to its network

# M(q) = sum_k c_k A_k + sum_j f_j(q) B_j
CONSTANTS: tuple[Constant, ...] = (
    Constant(start=1.25, scale=1.25, entries=((1, 1, 1.0),)),
    Constant(start=1.0, scale=1.0, entries=((0, 0, 1.0),)),
)
OUTPUTS = (
    Output(
        joints=(1,),
        mean=1.2652,
        scale=0.343656,
        level=1.25,
        terms=((0, 0.5, 0.0),),
        entries=((0, 0, 2.0), (1, 0, 1.0)),
    ),
)
# in each hidden layer: the joints that some units read, and how many units do
MASS_HIDDEN = (((1,), 64),)
GUARD = 0.07  # least eigenvalue of M, relative to its nominal mean, that is left as it is
POTENTIAL_JOINTS = (0, 1)  # the joints that V depends on
POTENTIAL_WIDTH = 32
POTENTIAL_SCALE = 10.8194  # [J]
POTENTIAL_TERMS: Terms = ((1, 0.0, 14.715), (2, 0.0, 4.905))
DEPTH = 2  # hidden layers of a network
FRICTION_HIDDEN = 8
SLOW = 0.03  # below this share of its usual speed dry friction fades to zero, to start from
SLOWEST = 0.001  # and at the least
FEATURES = 2 * len(JOINTS)  # numbers made of q, which networks read
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


class Reading(NamedTuple):
    """The inputs of a network: share * (spread features), (inputs, ...)."""

    joints: tuple[int, ...]  # whose each input is
    share: Tensor
    spread: Tensor  # (inputs, features)


def reading(joints: Iterable[int], shares: list[float]) -> Reading:
    """cos q and sin q of turning joints, the scaled q of sliding ones, times each joint's share."""
    n = len(JOINTS)
    turning = [joint for joint in joints if JOINTS[joint].revolute]
    whose = turning + turning
    places = turning + [n + joint for joint in turning]
    spread = torch.eye(FEATURES, dtype=torch.float64)[places]
    return Reading(tuple(whose), vector(shares[joint] for joint in whose), spread)


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

    def __init__(
        self,
        reading: Reading,
        layers: tuple[tuple[frozenset[int], ...], ...],
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.register_buffer("spread", reading.spread)
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
        nn.init.zeros_(self.weights[-1])  # so that the model starts at its nominal values

    def prepared(self, outlay: Tensor, offset: Tensor) -> Layers:
        """The weights for the features as they are, and for offset + outlay y in place of y.

        tanh x is computed as 2 sigmoid(2 x) - 1, which takes a fraction of the time.
        """
        weights, biases = [], []
        for index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            weight = weight * self.get_buffer(f"mask{index}")
            if index == 0:
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


class Series(nn.Module):
    """Sums of waves with trained factors, one for each output of a network beside it."""

    outputs: Tensor  # for each term, to which output it goes
    places: Tensor  # and where its wave stands
    size: Tensor  # in which its factor is counted

    def __init__(self, sums: list[Terms], scales: list[float], shares: list[float]) -> None:
        """Of terms in units of their output's scale; a wave counts as its joints' least share."""
        super().__init__()
        rows = []
        for output, (terms, scale) in enumerate(zip(sums, scales, strict=True)):
            for number, cos, sin in terms:
                turns = WAVES[number].turns
                size = min(share for share, turn in zip(shares, turns, strict=True) if turn)
                rows.append((output, number, cos / scale / size, size))
                rows.append((output, len(WAVES) + number, sin / scale / size, size))
        outputs, places, starts, sizes = zip(*rows, strict=True)
        self.register_buffer("outputs", torch.tensor(outputs))
        self.register_buffer("places", torch.tensor(places))
        self.register_buffer("size", vector(sizes))
        self.factors = nn.Parameter(vector(starts))

    def prepared(self, outlay: Tensor) -> Tensor:
        """What takes waves to outlay y, (rows, 2 waves), where y are the sums."""
        known = outlay.new_zeros(outlay.shape[1], 2 * len(WAVES))
        return outlay @ known.index_put((self.outputs, self.places), self.size * self.factors)


def leave_to_sums(network: Network, levels: Tensor) -> None:
    """Leave a network a small share of functions that are sums of waves, and the sums' levels."""
    network.biases[-1].data = levels
    network.get_buffer(f"mask{DEPTH}").mul_(NETWORK_SHARE)


class FrictionLayers(NamedTuple):
    """The friction networks' weights made ready for many states, all joints in one."""

    weight: Tensor
    bias: Tensor
    out: Tensor
    offset: Tensor
    viscous: Tensor  # [Nm s/rad, N s/m]
    slow: Tensor  # [rad^2/s^2, m^2/s^2]


class Friction(nn.Module):
    """Damping of each joint by its own q_i and qd_i: viscous, a constant, and dry, a network."""

    spread: Tensor  # where the inputs of a joint's network stand, (joints, inputs, features + 2 n)
    speed: Tensor
    size: Tensor

    def __init__(self, generator: torch.Generator) -> None:
        super().__init__()
        joints, inputs = len(JOINTS), 4
        spread = torch.zeros(joints, inputs, FEATURES + 2 * joints, dtype=torch.float64)
        for i, joint in enumerate(JOINTS):
            spread[i, 0, i] = spread[i, 1, joints + i] = PLACE_SHARE
            spread[i, 2, i - 2 * joints], spread[i, 3, i - joints] = 1 / joint.speed, 1.0
        self.register_buffer("spread", spread)
        self.register_buffer("speed", vector(joint.speed for joint in JOINTS))
        self.register_buffer("size", vector(joint.friction for joint in JOINTS))
        self.slow = nn.Parameter(torch.zeros(joints, dtype=torch.float64))
        self.viscous = nn.Parameter(torch.full((joints,), -2.0, dtype=torch.float64))
        shape = (joints, inputs, FRICTION_HIDDEN)
        weight = torch.randn(shape, dtype=torch.float64, generator=generator)
        self.weight = nn.Parameter(weight / inputs**0.5)
        self.bias = nn.Parameter(torch.zeros(joints, FRICTION_HIDDEN, dtype=torch.float64))
        self.out = nn.Parameter(torch.zeros(joints, FRICTION_HIDDEN, dtype=torch.float64))
        self.offset = nn.Parameter(torch.full((joints,), -2.0, dtype=torch.float64))

    def prepared(self) -> FrictionLayers:
        """All joints' networks as one: block matrices are faster than a loop over joints.

        Their tanh x is computed as 2 sigmoid(2 x) - 1, which takes a fraction of the time.
        """
        own = torch.eye(len(JOINTS), dtype=self.out.dtype, device=self.out.device)
        return FrictionLayers(
            weight=2 * (self.weight.mT @ self.spread).flatten(0, 1),
            bias=2 * self.bias.flatten(),
            out=2 * (own.unsqueeze(-1) * self.out).flatten(1),
            offset=self.offset - self.out.sum(dim=1),
            viscous=self.size * F.softplus(self.viscous) / self.speed,
            slow=self.speed**2 * (SLOWEST**2 + (SLOW * self.slow.exp()) ** 2),
        )

    def _dry(
        self, features: Tensor, qd: Tensor, direction: Tensor, layers: FrictionLayers
    ) -> Tensor:
        """Dry friction relative to its usual size, (..., n)."""
        inputs = torch.cat([features, qd, direction], dim=-1)
        hidden = torch.sigmoid(F.linear(inputs, layers.weight, layers.bias))
        return F.softplus(F.linear(hidden, layers.out, layers.offset))

    def forward(self, features: Tensor, qd: Tensor, layers: FrictionLayers) -> Tensor:
        """The friction torque D qd, (..., n) [Nm, N]."""
        direction = qd * torch.rsqrt(qd * qd + layers.slow)  # -1 or 1, smooth where it stands still
        dry = self._dry(features, qd, direction, layers)
        return layers.viscous * qd + self.size * direction * dry

    def matrix(self, features: Tensor, qd: Tensor, layers: FrictionLayers) -> Tensor:
        """D, (..., n, n) [Nm s/rad, N s/m], diagonal."""
        smooth_speed = torch.sqrt(qd * qd + layers.slow)
        dry = self._dry(features, qd, qd / smooth_speed, layers)
        return torch.diag_embed(layers.viscous + self.size * dry / smooth_speed)


class Features(NamedTuple):
    """Numbers made of q, which all else is made of."""

    own: Tensor  # cos q, sin q, (..., FEATURES)
    waves: Tensor  # cosines of all waves, then sines, (..., 2 waves)


class Prepared(NamedTuple):
    """What depends on the weights alone, worked out once for many states."""

    mass: Layers
    mass_waves: Tensor  # takes the waves to M
    rotors: Tensor
    least: Tensor  # M above this needs no guard
    potential: Layers
    potential_waves: Tensor  # takes the waves to V
    gravity_waves: Tensor  # and to dV/dq
    friction: FrictionLayers


# what M's derivatives need of the work done for M
Memory = tuple[Trace, Tensor | None, Tensor]


class Model(nn.Module):
    """The arm's dynamics: 1 learned function of q and 2 constants make the mass matrix.

    Shapes: q, qd, qdd, tau and p are (..., n), with any leading dimensions. Units: rad and Nm for
    turning joints, m and N for sliding ones. M is positive definite and D positive semi-definite
    for all weights.
    """

    n: ClassVar[int] = 2
    joint_names: ClassVar[tuple[str, ...]] = tuple(joint.name for joint in JOINTS)
    joint_types: ClassVar[tuple[str, ...]] = tuple(
        "revolute" if joint.revolute else "prismatic" for joint in JOINTS
    )

    turns: Tensor  # of joints by wave, (n, waves)
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
        turns = torch.tensor([wave.turns for wave in WAVES], dtype=torch.float64)
        self.register_buffer("turns", turns.mT)
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
        read = reading(sorted(frozenset().union(*outputs)), shares)
        self.mass_network = Network(read, (*((hidden,) * DEPTH), outputs), generator)
        scales = [output.scale for output in OUTPUTS]
        self.mass_series = Series([output.terms for output in OUTPUTS], scales, shares)
        levels = vector((output.level - output.mean) / output.scale for output in OUTPUTS)
        leave_to_sums(self.mass_network, levels)
        everything = frozenset(POTENTIAL_JOINTS)
        layers = (*(((everything,) * POTENTIAL_WIDTH,) * DEPTH), (everything,))
        shares = [joint.potential_share for joint in JOINTS]
        self.potential_network = Network(reading(POTENTIAL_JOINTS, shares), layers, generator)
        self.potential_series = Series([POTENTIAL_TERMS], [POTENTIAL_SCALE], shares)
        leave_to_sums(self.potential_network, vector([0.0]))
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
        heights = self.potential_series.prepared(scale)[0]
        return Prepared(
            mass=self.mass_network.prepared(outlay, constant),
            mass_waves=self.mass_series.prepared(outlay),
            rotors=rotors,
            least=(rotors + GUARD * self.mean_mass).detach(),
            potential=self.potential_network.prepared(scale, 0 * scale[0]),
            potential_waves=heights,
            gravity_waves=self._gravity_waves(heights),
            friction=self.friction.prepared(),
        )

    def _square(self, rows: Tensor) -> Tensor:
        """(..., n n) as (..., n, n)."""
        return rows.reshape(*rows.shape[:-1], self.n, self.n)

    def _features(self, q: Tensor) -> Features:
        """cos q, sin q; the waves: all that is read of q."""
        own = torch.cat([q.cos(), q.sin()], dim=-1)
        angle = q @ self.turns
        return Features(own, torch.cat([angle.cos(), angle.sin()], dim=-1))

    def _features_rate(self, features: Features, qd: Tensor) -> Features:
        """How fast the features change along qd."""
        cos, sin = features.own.chunk(2, dim=-1)
        own = torch.cat([-sin * qd, cos * qd], dim=-1)
        cos, sin = features.waves.chunk(2, dim=-1)
        turn = qd @ self.turns
        return Features(own, torch.cat([-sin * turn, cos * turn], dim=-1))

    def _by_joint(self, own: Tensor, slope: Tensor) -> Tensor:
        """d/dq, (..., n), of what has this slope by cos q, sin q."""
        cos, sin = own.chunk(2, dim=-1)
        by_cos, by_sin = slope.chunk(2, dim=-1)
        return by_sin * cos - by_cos * sin

    def _waves_by_joint(self, waves: Tensor, slope: Tensor) -> Tensor:
        """d/dq, (..., n), of what has this slope by waves."""
        cos, sin = waves.chunk(2, dim=-1)
        by_cos, by_sin = slope.chunk(2, dim=-1)
        return (by_sin * cos - by_cos * sin) @ self.turns.mT

    def _gravity_waves(self, heights: Tensor) -> Tensor:
        """What takes the waves to d/dq of waves @ heights, (2 waves, n)."""
        by_cos, by_sin = heights.unsqueeze(-1).chunk(2)
        return torch.cat([by_sin * self.turns.mT, -by_cos * self.turns.mT])

    def mass_matrix(self, q: Tensor, prepared: Prepared | None = None) -> Tensor:
        """M(q), (..., n, n) [kg m^2, kg m, kg]; with what ``prepare`` gave, where it is at hand."""
        return self._mass(self._features(q), prepared or self.prepare())[0]

    def _mass(self, features: Features, prepared: Prepared) -> tuple[Tensor, Memory]:
        """M(q), the network's trace and, where the guard is awake, its slope dl/dM, (..., n, n)."""
        rows, trace = self.mass_network(features.own, prepared.mass)
        rows = rows + F.linear(features.waves, prepared.mass_waves)
        mass = self._square(rows)
        if self._sound(mass, prepared):
            return mass, (trace, None, prepared.mass_waves)
        lift, slope = self._lift(mass - prepared.rotors)
        return mass + lift[..., None, None] * self.mean_mass, (trace, slope, prepared.mass_waves)

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

    def _kinetic_slope(self, qd: Tensor, memory: Memory) -> Features:
        """d/dfeatures of 1/2 qd^T M(q) qd."""
        trace, slope, waves = memory
        weight = (0.5 * qd).unsqueeze(-1) * qd.unsqueeze(-2)
        if slope is not None:
            weight = weight + (weight * self.mean_mass).sum(dim=(-2, -1))[..., None, None] * slope
        weight = weight.flatten(-2)
        return Features(self.mass_network.pull(trace, weight), weight @ waves)

    def _mass_rate(self, rate: Features, memory: Memory) -> Tensor:
        """dM/dt where the features change at this rate, (..., n, n)."""
        trace, slope, waves = memory
        pushed = self.mass_network.push(trace, rate.own) + F.linear(rate.waves, waves)
        mass_rate = self._square(pushed)
        if slope is not None:
            along = (slope * mass_rate).sum(dim=(-2, -1))[..., None, None]
            mass_rate = mass_rate + along * self.mean_mass
        return mass_rate

    def potential_energy(self, q: Tensor) -> Tensor:
        """V(q), (...) [J]."""
        features, prepared = self._features(q), self.prepare()
        y: Tensor = self.potential_network(features.own, prepared.potential)[0]
        return y.squeeze(-1) + features.waves @ prepared.potential_waves

    def gravity(self, q: Tensor) -> Tensor:
        """dV/dq, (..., n) [Nm, N]."""
        features, prepared = self._features(q), self.prepare()
        by_network = self._by_joint(features.own, self._potential_slope(features.own, prepared))
        return by_network + features.waves @ prepared.gravity_waves

    def _potential_slope(self, own: Tensor, prepared: Prepared) -> Tensor:
        """d/dfeatures of the network's part of V, (..., FEATURES)."""
        _, trace = self.potential_network(own, prepared.potential)
        return self.potential_network.pull(trace, own.new_ones(1))

    def dissipation(self, q: Tensor, qd: Tensor) -> Tensor:
        """D(q, qd), (..., n, n), diagonal: D qd is the friction torque."""
        return self.friction.matrix(self._features(q).own, qd, self.prepare().friction)

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
        self, features: Features, qd: Tensor, prepared: Prepared
    ) -> tuple[Tensor, Tensor]:
        """M and the torque that holds qd steady: dM/dt qd - d/dq (1/2 qd^T M qd) + dV/dq + D qd."""
        mass, memory = self._mass(features, prepared)
        mass_rate = self._mass_rate(self._features_rate(features, qd), memory)
        bias = (mass_rate @ qd.unsqueeze(-1)).squeeze(-1)
        bias = bias - self._lagrangian_slope(features, qd, memory, prepared)
        return mass, bias + self.friction(features.own, qd, prepared.friction)

    def _lagrangian_slope(
        self, features: Features, qd: Tensor, memory: Memory, prepared: Prepared
    ) -> Tensor:
        """d/dq of 1/2 qd^T M(q) qd - V(q), (..., n)."""
        kinetic = self._kinetic_slope(qd, memory)
        slope = kinetic.own - self._potential_slope(features.own, prepared)
        by_joint = self._by_joint(features.own, slope)
        by_joint = by_joint + self._waves_by_joint(features.waves, kinetic.waves)
        return by_joint - features.waves @ prepared.gravity_waves

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
        force = force - self.friction(features.own, qd, prepared.friction)
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
