"""The bodies of an arm: inertial parameters; positions, velocities and accelerations of their masses."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.parts import Row, Rows
from spelgen.runtime.port_hamiltonian import applied
from spelgen.runtime.rows import Joint, Link, vector


class ChainConfiguration(NamedTuple):
    """Four points per body at a position q, in the base frame, times the square roots of their masses."""

    place: Tensor  # positions, (..., 3, bodies, 4)
    mass: Tensor  # square roots of the masses, (..., 1, bodies, 4)
    axes: Tensor  # twist of a body per rate of its own displacement, (..., 6, bodies)
    jacobian: Tensor  # of the points, zero for bodies that a body does not carry, (..., bodies, 12 bodies)
    weight: Tensor  # -gravity, the equivalent acceleration of the base, times root masses, (..., 12 bodies)


class BodyChain(nn.Module):
    """Bodies that rotate about or translate along axes, each carried by another body or by the base.

    Twists are (angular, linear) in the base frame (Featherstone, Rigid Body Dynamics Algorithms, 2008);
    frames are 4 x 4 matrices (Uicker, J. Appl. Mech. 34:418, 1967). A body has the inertia of four
    points: the columns (position, 1) * sqrt(mass) of a root of its pseudo-inertia. Only the frames are
    computed one body after the other; sums over carrying or carried bodies are products with a mask,
    since the number of operations determines the time for small arms.
    """

    def __init__(
        self,
        n: int,
        gravity: Row,
        parent: Sequence[int],  # index of the carrying body; -1: the base
        joint: Sequence[int],
        revolute: Sequence[bool],  # rotation about z of the body frame, or translation along it,
        ratio: Row,  # by ratio * q + offset
        offset: Row,
        placement: Sequence[Rows],  # joint frame in the parent frame: three rows of [R p], p in m
    ) -> None:
        super().__init__()
        self.parents, count, turns = parent, len(parent), vector(revolute)
        # displacements are ratios q + offset, (bodies, n) and (bodies,)
        self.ratios = nn.Buffer(vector(ratio).unsqueeze(-1) * torch.eye(n)[list(joint)])
        self.offset, self.turns = nn.Buffer(vector(offset)), nn.Buffer(turns)
        # Rodrigues: with the 4 x 4 generator `rate` of a joint, a rotation by x is
        # 1 + sin(x) rate + (1 - cos(x)) rate^2, a translation 1 + x rate.
        start, rate = torch.eye(4).double().repeat(count, 1, 1), torch.zeros(count, 4, 4).double()
        start[:, :3] = torch.tensor(placement, dtype=torch.float64)
        rate[:, 1, 0], rate[:, 0, 1], rate[:, 2, 3] = turns, -turns, 1 - turns
        first, second = (start @ rate).flatten(1), (start @ rate @ rate).flatten(1)
        by_feature = [-second, turns.unsqueeze(-1) * first, (1 - turns).unsqueeze(-1) * first]
        # linear map from cos, sin and value of the displacements to the frames in parent frames,
        # (16 bodies, 3 bodies)
        blocks = [torch.ops.aten.block_diag([*x.unsqueeze(-1)]) for x in by_feature]
        self.table = nn.Buffer(torch.cat(blocks, dim=1))
        self.fixed = nn.Buffer((start.flatten(1) + second).flatten())  # constant part
        # linear map from twists to 3 x 4 matrices, which map points to velocities, (6, 12)
        unit = torch.eye(3).double()
        skew = torch.linalg.cross(unit.unsqueeze(-1), unit.unsqueeze(0), dim=1)
        self.motions = nn.Buffer(
            torch.cat([F.pad(skew, (0, 1)), F.pad(unit.unsqueeze(-1), (3, 0))]).flatten(1)
        )
        carriers = torch.eye(count).double()
        for index, carrier in enumerate(parent):
            if carrier >= 0:
                carriers[:, index] += carriers[:, carrier]
        # (bodies, bodies): 1 if the body of the row carries the body of the column, or is the same
        self.carriers = nn.Buffer(carriers)
        # the same mask for coordinates of the points, (bodies, 12 bodies)
        self.carried = nn.Buffer(carriers.repeat_interleave(4, dim=1).repeat(1, 3))
        # acceleration of the base that is equivalent to gravity, (3, 1, 1)
        self.base = nn.Buffer(-vector(gravity)[:, None, None])

    def forward(self, q: Tensor, points: Tensor) -> ChainConfiguration:
        """Return the bodies at q, (..., n); points: in body frames, block diagonal, (4 bodies, 4 bodies)."""
        # Displacements of all bodies at once: mimic joints are multiples of a coordinate, plus an offset.
        value = q @ self.ratios.mT + self.offset
        features = torch.cat([value.cos(), value.sin(), value], dim=-1)
        # One product gives all frames relative to their parents: they are linear in cos, sin and value.
        relative = torch.unflatten(F.linear(features, self.table, self.fixed), -1, (-1, 4, 4)).unbind(dim=-3)
        # A parent precedes its children, so its frame in the base is known.
        placed: list[Tensor] = []
        for index, parent in enumerate(self.parents):
            placed.append(relative[index] if parent < 0 else placed[parent] @ relative[index])
        frames = torch.cat(placed, dim=-1)
        z, origin = torch.unflatten(frames[..., :3, :], -1, (-1, 4))[..., 2:].unbind(dim=-1)
        angular = self.turns * z
        # Twist of a unit rate: (z, origin x z) for a rotation, (0, z) for a translation.
        axes = torch.cat([angular, torch.linalg.cross(origin, angular, dim=-2) + (z - angular)], dim=-2)
        points = frames @ points
        # Velocity of every point of a body per rate of every body, of which the carried ones are kept.
        motions = torch.unflatten(axes.mT @ self.motions, -1, (3, 4)).flatten(-3, -2) @ points
        jacobian = torch.unflatten(motions, -2, (-1, 3)).flatten(-2) * self.carried
        place, mass = torch.unflatten(points, -1, (-1, 4)).tensor_split((3,), dim=-3)
        return ChainConfiguration(place, mass, axes, jacobian, (self.base * mass).flatten(-3))

    def motion(self, cache: ChainConfiguration, qd: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return velocities of the points, twists and axis rates at qd, (..., n).

        Velocities are (..., 3, bodies, 4), times the root masses. The twist of each body and the rate of
        its axis are (..., 6, bodies) (Featherstone, 2.31).
        """
        rates = qd @ self.ratios.mT
        # Sums over carrying bodies are products with masks.
        velocity = torch.unflatten(applied(cache.jacobian.mT, rates), -1, (3, -1, 4))
        twists = (cache.axes * rates.unsqueeze(-2)) @ self.carriers
        (w, u), (a, m) = twists.chunk(2, dim=-2), cache.axes.chunk(2, dim=-2)
        # Rate of an axis (a, m) that moves with the twist (w, u): (w x a, w x m + u x a).
        linear = torch.linalg.cross(w, m, dim=-2) + torch.linalg.cross(u, a, dim=-2)
        return velocity, twists, torch.cat([torch.linalg.cross(w, a, dim=-2), linear], dim=-2)

    def accelerations(self, cache: ChainConfiguration, qd: Tensor) -> Tensor:
        """Return accelerations at constant qd, minus gravity, times the root masses, (..., 12 bodies)."""
        velocity, twists, turning = self.motion(cache, qd)
        steady = (turning * (qd @ self.ratios.mT).unsqueeze(-2)) @ self.carriers
        w, (a, u) = twists[..., :3, :, None], steady.unsqueeze(-1).chunk(2, dim=-3)
        # Acceleration of a point at constant rates: w x v + dw/dt x p + du/dt.
        turned = torch.linalg.cross(w, velocity, dim=-3) + torch.linalg.cross(a, cache.place, dim=-3)
        return torch.addcmul(turned, u, cache.mass).flatten(-3) + cache.weight

    def kinetic_gradient(self, cache: ChainConfiguration, qd: Tensor) -> Tensor:
        """Return d/dq of the kinetic energy at qd, (..., n)."""
        velocity, _, turning = self.motion(cache, qd)
        # Angular and linear momentum of the points about the origin of the base.
        momenta = [torch.linalg.cross(cache.place, velocity, dim=-3), cache.mass * velocity]
        # Momentum of all bodies that a body carries, projected onto the rate of its axis. The rotation of
        # the points about the axis adds nothing: (a x v) . v = 0.
        carried = torch.cat(momenta, dim=-3).sum(dim=-1) @ self.carriers.mT
        return (turning * carried).sum(dim=-2) @ self.ratios


def chain_of_links(joints: Sequence[Joint], links: Sequence[Link], gravity: Row) -> BodyChain:
    """Return the kinematics of these links; gravity: acceleration in the base frame, (3,) [m/s^2]."""
    names, number = [link.name for link in links], {joint.name: k for k, joint in enumerate(joints)}
    types = [link.joint_type or joints[number[link.joint]].joint_type for link in links]
    return BodyChain(
        n=len(joints),
        gravity=gravity,
        parent=[-1 if link.parent is None else names.index(link.parent) for link in links],
        joint=[number[link.joint] for link in links],
        revolute=[joint_type == "revolute" for joint_type in types],
        ratio=[link.ratio for link in links],
        offset=[link.offset for link in links],
        placement=[
            [(*row, x) for row, x in zip(link.rotation, link.position, strict=True)] for link in links
        ],
    )


def body_factor(parameters: Tensor) -> Tensor:
    """Return T from log-Cholesky parameters, both upper triangular, (..., 4, 4)."""
    logarithms = parameters.diagonal(dim1=-2, dim2=-1)
    sizes, mass = logarithms[..., :3], logarithms[..., 3:] / 2
    scale = torch.cat([sizes + mass, mass], dim=-1).exp()
    return scale.unsqueeze(-1) * (parameters.triu(1) + torch.eye(4).to(parameters))


def pseudo_inertia(link: Link) -> Tensor:
    """Return [[S, m c], [(m c)^T, m]], (4, 4), in the joint's frame: S = tr(I)/2 1 - I + m c c^T."""
    xx, xy, xz, yy, yz, zz = link.inertia
    inertia = torch.tensor([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], dtype=torch.float64)
    center = torch.tensor([*link.center_of_mass, 1.0], dtype=torch.float64)
    pseudo = link.mass * torch.outer(center, center)
    pseudo[:3, :3] += inertia.trace() / 2 * torch.eye(3, dtype=torch.float64) - inertia
    return pseudo


class InertialParameters(nn.Module):
    """Inertial parameters that are physically consistent for all trained parameters; these start at zero.

    The pseudo-inertia of a body is [[S, m c], [(m c)^T, m]], S the second moments in its joint's frame. It
    is C T T^T C^T, with C and T upper triangular, and C C^T the pseudo-inertia of the given link. T is a
    function of log-Cholesky parameters (Rucker and Wensing, IEEE RA-L 7:4352, 2022): logarithms of mass and
    of the extent along three axes, relative to the given ones, and shear and center of mass in units of the
    extents.
    """

    parameter_groups = (("raw", "bodies", "kg, kg m, kg m^2"),)

    def __init__(self, links: Sequence[Link]) -> None:
        super().__init__()
        # from the entries of an upper triangle, rows in sequence, to a matrix
        row, column = torch.triu_indices(4, 4)
        self.triangle = nn.Buffer(torch.eye(16, dtype=torch.float64)[4 * row + column])
        pseudo = torch.stack([pseudo_inertia(link) for link in links])
        # upper triangular factors, by the lower ones of the matrix with rows and columns in reverse order
        self.factors = nn.Buffer(torch.linalg.cholesky(pseudo.flip(-1, -2)).flip(-1, -2))
        self.raw = nn.Parameter(torch.zeros(len(links), 10, dtype=torch.float64))

    def forward(self) -> Tensor:
        """Return C T of each body, (bodies, 4, 4): the columns are four points with its inertia."""
        return self.factors @ body_factor(torch.unflatten(self.raw @ self.triangle, -1, (4, 4)))
