r"""Port-Hamiltonian model of an arm with 3 joints, written by `spelgen build`.

3 bodies with trained inertial parameters make mass matrix and potential energy.
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
    spec_sha256: "d30d581a4dd143d8a10386bee233d1676ad54855f3d679f8cf2ef81981f5bc95"
    option assume: "kinematics"
    option depth: 2
    option joints: null
    option net: "mlp"
    option preset: "closed-form"
    option snap_tolerance: 0.002
    option tip: null
    option width: 64
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn

Row = tuple[float, float, float]


class Joint(NamedTuple):
    """A joint; angles are in rad, lengths in m."""

    name: str
    revolute: bool
    speed: float  # usual speed
    friction: float  # usual size of the friction torque
    rotor: float  # what its drive adds to M at the start: rotor inertia times gear squared
    actuated: bool


class Body(NamedTuple):
    """All that moves rigidly with a joint, whose frame's z it turns about, or slides along."""

    parent: int  # -1: the base
    joint: int
    revolute: bool
    ratio: float  # it moves by ratio * q + offset
    offset: float
    rotation: tuple[Row, Row, Row]  # of the joint's frame in its parent's
    position: Row  # likewise [m]
    # where training starts: m, m c, Ixx, Ixy, Ixz, Iyy, Iyz, Izz about the joint
    reference: tuple[float, ...]


JOINTS = (
    Joint(name="joint1", revolute=True, speed=3.0, friction=0.4, rotor=0.133, actuated=True),
    Joint(name="joint2", revolute=False, speed=1.0, friction=0.4, rotor=0.4, actuated=True),
    Joint(name="joint3", revolute=True, speed=6.0, friction=0.4, rotor=0.0667, actuated=True),
)
BODIES = (
    Body(
        parent=-1,
        joint=0,
        revolute=True,
        ratio=1.0,
        offset=0.0,
        rotation=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        position=(0.0, 0.0, 0.0),
        reference=(5.01, 0.0, 0.0, -4.48896, 4.13010816, 0.0, 0.0, 4.12210816, 0.0, 0.018),
    ),
    Body(
        parent=0,
        joint=1,
        revolute=False,
        ratio=1.0,
        offset=0.0,
        rotation=((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
        position=(0.0, 0.0, 0.154),
        reference=(
            4.25,
            0.0,
            -0.086275,
            -27.4125,
            179.3223763825,
            0.0,
            0.0,
            179.320625,
            -0.55647375,
            0.0077513825,
        ),
    ),
    Body(
        parent=1,
        joint=2,
        revolute=True,
        ratio=1.0,
        offset=0.0,
        rotation=((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
        position=(0.0, -0.0203, 0.0),
        reference=(
            1.08,
            0.0,
            0.09936,
            -0.05832,
            0.0142904,
            0.0,
            0.0,
            0.00425851,
            0.00536544,
            0.0102504,
        ),
    ),
)
GRAVITY = (0.0, 0.0, -9.81)  # [m/s^2]

# where friction's trained constants start, relative to a joint's usual friction and speed
STRIBECK = 0.3  # dry friction that only slow motion has
FADING = 0.03  # speed at which that has faded
JUMP = 0.006  # speed over which dry friction turns around
BEND = 0.2  # speed at which viscous friction begins to grow more slowly
LOAD = 0.03  # dry friction by gravity torque


def vector(values: Iterable[float]) -> Tensor:
    """The values as a float64 tensor."""
    return torch.tensor(list(values), dtype=torch.float64)


def skew(a: Tensor) -> Tensor:
    """[a]x, (..., 3, 3), with [a]x b = a x b."""
    x, y, z = a.unbind(dim=-1)
    zero = torch.zeros_like(x)
    rows = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1)
    return rows.reshape(*a.shape[:-1], 3, 3)


def twist_map(turn: Tensor, position: Tensor) -> Tensor:
    """Takes twists (angular, linear) to a frame at ``position`` turned by ``turn``^T, (6, 6)."""
    top = torch.cat([turn, torch.zeros_like(turn)], dim=1)
    return torch.cat([top, torch.cat([-turn @ skew(position), turn], dim=1)])


def transform_table(body: Body) -> Tensor:
    """Its twist map from the parent is table[0] + cos table[1] + sin table[2] + slide table[3]."""
    turn, position = torch.stack([vector(row) for row in body.rotation]).mT, vector(body.position)
    table = torch.zeros(4, 6, 6, dtype=torch.float64)
    if body.revolute:
        about = torch.zeros(3, 3, 3, dtype=torch.float64)
        about[0, 2, 2] = about[1, 0, 0] = about[1, 1, 1] = about[2, 0, 1] = 1
        about[2, 1, 0] = -1
        for term in range(3):
            table[term] = twist_map(about[term] @ turn, position)
    else:
        table[0] = twist_map(turn, position)
        table[3] = twist_map(turn, position + turn[2]) - table[0]
    return table


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


class FrictionConstants(NamedTuple):
    """By joint, (n,), all positive."""

    viscous: Tensor  # [Nm s/rad, N s/m]
    bend: Tensor  # [Nm, N]
    bend_speed: Tensor  # [rad/s, m/s]
    coulomb: Tensor  # [Nm, N]
    stribeck: Tensor  # [Nm, N]
    fading: Tensor  # [rad/s, m/s]
    jump: Tensor  # [rad/s, m/s]
    load: Tensor  # dry friction by gravity torque


class Friction(nn.Module):
    """Friction of each joint, which resists whatever the weights are: the weights are logarithms.

    viscous qd + bend tanh(qd / bend_speed)
    + (coulomb + stribeck exp(-(qd / fading)^2) + load |gravity torque|) tanh(qd / jump).
    """

    size: Tensor
    speed: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("size", vector(joint.friction for joint in JOINTS))
        self.register_buffer("speed", vector(joint.speed for joint in JOINTS))
        start = torch.zeros(len(JOINTS), dtype=torch.float64)
        self.viscous = nn.Parameter(start.clone())
        self.bend = nn.Parameter(start.clone())
        self.bend_speed = nn.Parameter(start.clone())
        self.coulomb = nn.Parameter(start.clone())
        self.stribeck = nn.Parameter(start.clone())
        self.fading = nn.Parameter(start.clone())
        self.jump = nn.Parameter(start.clone())
        self.load = nn.Parameter(start.clone())

    def prepared(self) -> FrictionConstants:
        """The constants of the present weights."""
        size, speed = self.size, self.speed
        return FrictionConstants(
            viscous=size / speed * self.viscous.exp(),
            bend=size * self.bend.exp(),
            bend_speed=BEND * speed * self.bend_speed.exp(),
            coulomb=size * self.coulomb.exp(),
            stribeck=STRIBECK * size * self.stribeck.exp(),
            fading=FADING * speed * self.fading.exp(),
            jump=JUMP * speed * self.jump.exp(),
            load=LOAD * size.sign() * self.load.exp(),
        )

    def resistance(self, qd: Tensor, gravity: Tensor, constants: FrictionConstants) -> Tensor:
        """The diagonal of D, (..., n): friction torque by velocity."""
        slow = (-((qd / constants.fading) ** 2)).exp()
        dry = constants.coulomb + constants.stribeck * slow + constants.load * gravity.abs()
        dry = dry / constants.jump * self._flattening(qd / constants.jump)
        bend = constants.bend / constants.bend_speed * self._flattening(qd / constants.bend_speed)
        return constants.viscous + bend + dry

    def forward(self, qd: Tensor, gravity: Tensor, constants: FrictionConstants) -> Tensor:
        """The friction torque D qd, (..., n) [Nm, N], under this gravity torque."""
        return self.resistance(qd, gravity, constants) * qd

    @staticmethod
    def _flattening(x: Tensor) -> Tensor:
        """tanh(x) / x."""
        near = x.abs() < 1e-4
        safe = torch.where(near, torch.ones_like(x), x)
        return torch.where(near, 1 - x**2 / 3, safe.tanh() / safe)


class Prepared(NamedTuple):
    """What depends on the weights alone, worked out once for many states."""

    inertia: Tensor  # spatial inertias, (bodies, 6, 6)
    rotors: Tensor  # (n,)
    friction: FrictionConstants
    input: Tensor  # (n, n)


class Motion(NamedTuple):
    """How the bodies may move at a position, each in its own frame."""

    maps: Tensor  # twists from the parent's frame, (..., bodies, 6, 6)
    twists: Tensor  # by joint velocity, (..., bodies, 6, n)
    weight: Tensor  # acceleration that stands for gravity, (..., bodies, 6)


class Model(nn.Module):
    """The arm's dynamics: 3 rigid bodies with trained inertial parameters.

    Shapes: q, qd, qdd, tau and p are (..., n), with any leading dimensions. Units: rad and Nm for
    turning joints, m and N for sliding ones. M is positive definite and D positive semi-definite
    for all weights. Spatial vectors are (angular, linear), as in Featherstone, Rigid Body Dynamics
    Algorithms, 2008.
    """

    n: ClassVar[int] = 3
    joint_names: ClassVar[tuple[str, ...]] = tuple(joint.name for joint in JOINTS)
    joint_types: ClassVar[tuple[str, ...]] = tuple(
        "revolute" if joint.revolute else "prismatic" for joint in JOINTS
    )

    tables: Tensor
    axes: Tensor  # twist of a body by the velocity of its joint, (bodies, 6, n)
    ratios: Tensor
    offsets: Tensor
    factors: Tensor
    triangle: Tensor
    basis: Tensor
    crossing: Tensor
    base: Tensor
    rotor_size: Tensor
    actuated: Tensor

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        kind = torch.float64
        self.register_buffer("tables", torch.stack([transform_table(body) for body in BODIES]))
        axes = torch.zeros(len(BODIES), 6, self.n, dtype=kind)
        for index, body in enumerate(BODIES):
            axes[index, 2 if body.revolute else 5, body.joint] = body.ratio
        self.register_buffer("axes", axes)
        self.register_buffer("ratios", axes.sum(dim=1))
        self.register_buffer("offsets", vector(body.offset for body in BODIES))
        reference = torch.stack([vector(body.reference) for body in BODIES])
        self.register_buffer("factors", torch.linalg.cholesky(pseudo_inertia(reference)))
        row, column = torch.tril_indices(4, 4)
        self.register_buffer("triangle", torch.eye(16, dtype=kind)[4 * row + column])
        self.register_buffer("basis", inertia_basis())
        crossing = torch.zeros(6, 6, 6, dtype=kind)
        for axis, unit in enumerate(torch.eye(3, dtype=kind)):
            crossing[axis, :3, :3] = crossing[axis, 3:, 3:] = skew(unit)
            crossing[3 + axis, 3:, :3] = skew(unit)
        self.register_buffer("crossing", crossing)
        self.register_buffer("base", vector((0, 0, 0, *(-g for g in GRAVITY))))
        self.register_buffer("rotor_size", vector(joint.rotor for joint in JOINTS))
        self.register_buffer("actuated", vector(float(joint.actuated) for joint in JOINTS))
        # by body, ten coordinates of its pseudo-inertia; zero is the reference
        self.bodies = nn.Parameter(torch.zeros(len(BODIES), 10, dtype=kind))
        self.rotor = nn.Parameter(torch.zeros(self.n, dtype=kind))
        self.friction = Friction()
        # of the measured torque, in units of the joints' usual friction
        self.offset = nn.Parameter(torch.zeros(self.n, dtype=kind))

    def inertial_parameters(self) -> Tensor:
        """By body (m, m c, Ixx, Ixy, Ixz, Iyy, Iyz, Izz) about its joint's frame, (bodies, 10).

        Its pseudo-inertia is C T T^T C^T, with C of the reference and T lower triangular, the
        diagonal exponentials: a possible body for all weights (Rucker and Wensing, IEEE RA-L
        7:4352, 2022).
        """
        on_diagonal = self.triangle[:, ::5].sum(dim=1) > 0
        lower = torch.where(on_diagonal, self.bodies.exp(), self.bodies) @ self.triangle
        root = self.factors @ lower.reshape(-1, 4, 4)
        pseudo = root @ root.mT
        moments, tensor = pseudo[:, 3, :3], -pseudo[:, :3, :3]
        trace = -tensor.diagonal(dim1=-2, dim2=-1).sum(dim=-1)
        xx, yy, zz = (trace.unsqueeze(-1) + tensor.diagonal(dim1=-2, dim2=-1)).unbind(dim=-1)
        xy, xz, yz = tensor[:, 0, 1], tensor[:, 0, 2], tensor[:, 1, 2]
        six = torch.stack([xx, xy, xz, yy, yz, zz], dim=-1)
        return torch.cat([pseudo[:, 3, 3:], moments, six], dim=-1)

    def prepare(self) -> Prepared:
        """All that depends on the weights alone; holds until they change."""
        return Prepared(
            inertia=torch.tensordot(self.inertial_parameters(), self.basis, dims=1),
            rotors=self.rotor_size * self.rotor.exp(),
            friction=self.friction.prepared(),
            input=self._inputs(),
        )

    def _motion(self, q: Tensor) -> Motion:
        value = q @ self.ratios.mT + self.offsets
        terms = torch.stack([torch.ones_like(value), value.cos(), value.sin(), value], dim=-1)
        maps = (terms.unsqueeze(-2) @ self.tables.flatten(2)).reshape(*value.shape, 6, 6)
        still = torch.cat([torch.zeros_like(self.axes[0]), self.base.unsqueeze(-1)], dim=-1)
        own = torch.cat([self.axes, torch.zeros_like(self.axes[..., :1])], dim=-1)
        moved: list[Tensor] = []
        for index, body in enumerate(BODIES):
            parent = still if body.parent < 0 else moved[body.parent]
            moved.append(maps[..., index, :, :] @ parent + own[index])
        columns = torch.stack(moved, dim=-3)
        return Motion(maps, columns[..., :-1], columns[..., -1])

    def _cross(self, twist: Tensor) -> Tensor:
        """What a frame with this twist makes of a constant twist in it, (..., 6, 6)."""
        rows = twist @ self.crossing.flatten(1)
        return rows.reshape(*twist.shape[:-1], 6, 6)

    def mass_matrix(self, q: Tensor, prepared: Prepared | None = None) -> Tensor:
        """M(q), (..., n, n) [kg m^2, kg m, kg]; with what ``prepare`` gave, where it is at hand."""
        return self._mass(self._motion(q), prepared or self.prepare())

    def _mass(self, motion: Motion, prepared: Prepared) -> Tensor:
        inertia = (motion.twists.mT @ (prepared.inertia @ motion.twists)).sum(dim=-3)
        return inertia + torch.diag(prepared.rotors)

    def potential_energy(self, q: Tensor) -> Tensor:
        """V(q), (...) [J]; zero for a mass at the base's origin."""
        maps = self._motion(q).maps
        inertia, height = self.prepare().inertia, q.new_zeros(q.shape[:-1])
        placed: list[Tensor] = []
        for index, body in enumerate(BODIES):
            own = maps[..., index, :, :]
            placed.append(own if body.parent < 0 else own @ placed[body.parent])
            # in the base's frame the moment of mass stands in the inertia's upper right block
            seen = placed[index].mT @ (inertia[index] @ placed[index])
            moment = torch.stack([seen[..., 2, 4], seen[..., 0, 5], seen[..., 1, 3]], dim=-1)
            height = height + moment @ self.base[3:]
        return height

    def gravity(self, q: Tensor) -> Tensor:
        """dV/dq, (..., n) [Nm, N]."""
        return self._weight(self._motion(q), self.prepare())

    def _weight(self, motion: Motion, prepared: Prepared) -> Tensor:
        return self._by_joint(motion, self._applied(prepared.inertia, motion.weight))

    @staticmethod
    def _applied(matrices: Tensor, vectors: Tensor) -> Tensor:
        return (matrices @ vectors.unsqueeze(-1)).squeeze(-1)

    @staticmethod
    def _by_joint(motion: Motion, wrenches: Tensor) -> Tensor:
        """Joint torques, (..., n), that wrenches on the bodies, (..., bodies, 6), stand for."""
        return (wrenches.unsqueeze(-2) @ motion.twists).squeeze(-2).sum(dim=-2)

    def _twists(self, motion: Motion, qd: Tensor) -> Tensor:
        """The bodies' velocities, (..., bodies, 6)."""
        return self._applied(motion.twists, qd.unsqueeze(-2))

    def _accelerations(self, motion: Motion, qd: Tensor, twists: Tensor) -> Tensor:
        """The bodies' accelerations at steady qd, gravity taken as one, (..., bodies, 6)."""
        turned = self._applied(self._cross(twists) @ self.axes, qd.unsqueeze(-2))
        found: list[Tensor] = []
        for index, body in enumerate(BODIES):
            own = turned[..., index, :]
            if body.parent >= 0:
                own = own + self._applied(motion.maps[..., index, :, :], found[body.parent])
            found.append(own)
        return torch.stack(found, dim=-2) + motion.weight

    def _kinetic_slope(self, motion: Motion, qd: Tensor, prepared: Prepared) -> Tensor:
        """d/dq of 1/2 qd^T M(q) qd, (..., n): the momentum of all that a joint carries, by what its
        displacement adds to their twist.
        """
        twists = self._twists(motion, qd)
        turned = self._cross(twists) @ self.axes
        carried = list(self._applied(prepared.inertia, twists).unbind(dim=-2))
        for index in reversed(range(len(BODIES))):
            parent = BODIES[index].parent
            if parent >= 0:
                back = motion.maps[..., index, :, :].mT
                carried[parent] = carried[parent] + self._applied(back, carried[index])
        momenta = torch.stack(carried, dim=-2)
        return (momenta.unsqueeze(-2) @ turned).squeeze(-2).sum(dim=-2)

    def _bias(self, motion: Motion, qd: Tensor, prepared: Prepared) -> Tensor:
        """The torque that holds qd steady, (..., n), friction included."""
        twists = self._twists(motion, qd)
        accelerations = self._accelerations(motion, qd, twists)
        momenta = self._applied(prepared.inertia, twists)
        wrenches = self._applied(prepared.inertia, accelerations)
        wrenches = wrenches - self._applied(self._cross(twists).mT, momenta)
        friction: Tensor = self.friction(qd, self._weight(motion, prepared), prepared.friction)
        return self._by_joint(motion, wrenches) + friction

    def regressor(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """Y, (..., n, 10 bodies): Y @ ``inertial_parameters().flatten()`` is the bodies' torque."""
        motion = self._motion(q)
        twists = self._twists(motion, qd)
        accelerations = self._accelerations(motion, qd, twists) + self._twists(motion, qdd)
        # by body and parameter: (..., bodies, 6, 10)
        rises = torch.tensordot(accelerations, self.basis, dims=([-1], [2])).mT
        momenta = torch.tensordot(twists, self.basis, dims=([-1], [2])).mT
        wrenches = rises - self._cross(twists).mT @ momenta
        rows: Tensor = (motion.twists.mT @ wrenches).transpose(-3, -2)
        return rows.reshape(*q.shape, 10 * len(BODIES))

    def dissipation(self, q: Tensor, qd: Tensor) -> Tensor:
        """D(q, qd), (..., n, n), diagonal: D qd is the friction torque."""
        prepared = self.prepare()
        weight = self._weight(self._motion(q), prepared)
        return torch.diag_embed(self.friction.resistance(qd, weight, prepared.friction))

    def input_matrix(self, q: Tensor) -> Tensor:
        """G, (..., n, n): joint torques by inputs, one for each actuated joint."""
        return self._inputs().expand(*q.shape[:-1], self.n, self.n)

    def _inputs(self) -> Tensor:
        return torch.diag(self.actuated)

    def torque_offset(self) -> Tensor:
        """What the measured torque shows without any, (n,) [Nm, N]."""
        return self.offset * self.friction.size * self.actuated

    def momentum(self, q: Tensor, qd: Tensor, prepared: Prepared | None = None) -> Tensor:
        """p = M(q) qd, (..., n)."""
        return self._applied(self.mass_matrix(q, prepared), qd)

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
        prepared, motion = self.prepare(), self._motion(q)
        force = (tau - self.torque_offset()) @ prepared.input.mT
        return self._solved(self._mass(motion, prepared), force - self._bias(motion, qd, prepared))

    def inverse_dynamics(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """The torque, (..., n), that gives qdd."""
        prepared, motion = self.prepare(), self._motion(q)
        force = self._applied(self._mass(motion, prepared), qdd) + self._bias(motion, qd, prepared)
        # a joint without a motor shows the torque that it lacks
        moved = prepared.input + torch.diag(1 - self.actuated)
        return self._solved(moved, force) + self.torque_offset()

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
        motion = self._motion(q)
        qd = self._solved(self._mass(motion, prepared), p)
        weight = self._weight(motion, prepared)
        force = self._kinetic_slope(motion, qd, prepared) - weight
        force = force - self.friction(qd, weight, prepared.friction)
        if tau is not None:
            force = force + (tau - self.torque_offset()) @ prepared.input.mT
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
