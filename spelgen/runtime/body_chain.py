"""Kinematics and inertial parameters of the bodies of an arm, each represented by four point masses."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.parts import Row, Rows, applied
from spelgen.runtime.rows import Joint, Link, vector


class ChainConfiguration(NamedTuple):
    """Configuration cache of ``BodyChain``: its quantities that depend on q only, in the base frame.

    Four point masses represent a rigid body (see ``BodyChain``). Coordinates and velocities of a point
    mass are multiplied by the square root of its mass. The sum of all squared velocities is then twice
    the kinetic energy, and a sum of products of two coordinates is a second moment of mass.
    """

    place: Tensor  # positions of the point masses times sqrt(mass), (..., 3, B bodies, 4 points) [m kg^(1/2)]
    mass: Tensor  # sqrt(mass) of the point masses in `place`, (..., 1, B bodies, 4 points) [kg^(1/2)]
    axes: Tensor  # twist of each body relative to its parent per unit joint rate, (..., 6, B bodies)
    # Derivatives of the coordinates of all point masses with respect to the joint displacement of each
    # body, times sqrt(mass), (..., B, 12 B). The last axis is a flattened array (3 coordinates, B bodies,
    # 4 point masses).
    jacobian: Tensor
    # Minus the acceleration of gravity for each of the 3 coordinates of each point mass, times
    # sqrt(mass), (..., 12 B) for B bodies of 4 points each [m/s^2 kg^(1/2)].
    weight: Tensor


class BodyChain(nn.Module):
    """A tree of bodies: each rotates about or translates along an axis of the body or base that carries it.

    Twists are (angular, linear) in the base frame (Featherstone, Rigid Body Dynamics Algorithms, 2008);
    frames are 4 x 4 matrices (Uicker, J. Appl. Mech. 34:418, 1967). Each body is represented by four
    point masses that have the same pseudo-inertia P: the columns (position, 1) * sqrt(mass) of a matrix Q
    with Q Q^T = P. Only the frames are computed recursively. Sums over the bodies that a joint carries,
    or over the joints that carry a body, are computed as one product with a matrix of zeros and ones.
    This is fast for small arms, for which the time depends on the number of tensor operations and not on
    their size.
    """

    def __init__(
        self,
        n: int,
        gravity: Row,
        parent: Sequence[int],  # index of each body's parent body; -1: the base
        joint: Sequence[int],
        revolute: Sequence[bool],  # True: rotation about z of the joint frame; False: translation along z
        ratio: Row,  # displacement of a body's joint: ratio * q + offset
        offset: Row,
        placement: Sequence[Rows],  # joint frame in the frame of the parent body: three rows of [R p], p in m
    ) -> None:
        super().__init__()
        self.parents, count, turns = parent, len(parent), vector(revolute)
        # The joint displacements of all bodies are ratios q + offset; ratios: (bodies, n), offset: (bodies,).
        self.ratios = nn.Buffer(vector(ratio).unsqueeze(-1) * torch.eye(n)[list(joint)])
        self.offset, self.turns = nn.Buffer(vector(offset)), nn.Buffer(turns)
        # Rodrigues' formula for the 4 x 4 transform of a joint, with the identity matrix I and the generator
        # `rate`: a rotation by x is I + sin(x) rate + (1 - cos(x)) rate^2, a translation is I + x rate.
        start, rate = torch.eye(4).double().repeat(count, 1, 1), torch.zeros(count, 4, 4).double()
        start[:, :3] = torch.tensor(placement, dtype=torch.float64)
        rate[:, 1, 0], rate[:, 0, 1], rate[:, 2, 3] = turns, -turns, 1 - turns
        first, second = (start @ rate).flatten(1), (start @ rate @ rate).flatten(1)
        by_feature = [-second, turns.unsqueeze(-1) * first, (1 - turns).unsqueeze(-1) * first]
        # For the joint displacements x of all bodies, the 4 x 4 frames of the bodies relative to their
        # parents are linear in cos x, sin x and x. `table`, (16 bodies, 3 bodies): coefficients; `fixed`:
        # constants.
        blocks = [torch.ops.aten.block_diag([*x.unsqueeze(-1)]) for x in by_feature]
        self.table = nn.Buffer(torch.cat(blocks, dim=1))
        self.fixed = nn.Buffer((start.flatten(1) + second).flatten())
        # `motions`: linear map, (6, 12), from a twist to the 3 x 4 matrix that maps (position, 1) of a point
        # to the velocity of the point.
        unit = torch.eye(3).double()
        skew = torch.linalg.cross(unit.unsqueeze(-1), unit.unsqueeze(0), dim=1)
        self.motions = nn.Buffer(
            torch.cat([F.pad(skew, (0, 1)), F.pad(unit.unsqueeze(-1), (3, 0))]).flatten(1)
        )
        carriers = torch.eye(count).double()
        for index, carrier in enumerate(parent):
            if carrier >= 0:
                carriers[:, index] += carriers[:, carrier]
        # `carriers`, (bodies, bodies): entry (i, j) is 1 if body i carries body j or i = j, else 0.
        self.carriers = nn.Buffer(carriers)
        # `carried`, (bodies, 12 bodies): `carriers`, with 12 columns for the coordinates of the four
        # point masses of a body. The Jacobian of the point masses with respect to the joint displacements
        # is multiplied by it, and is then zero for points that a joint does not carry.
        self.carried = nn.Buffer(carriers.repeat_interleave(4, dim=1).repeat(1, 3))
        # `base`: minus the acceleration of gravity, in the base frame, (3, 1, 1) [m/s^2].
        self.base = nn.Buffer(-vector(gravity)[:, None, None])

    def forward(self, q: Tensor, points: Tensor) -> ChainConfiguration:
        """Return the configuration cache at q: positions and Jacobian of the point masses, and joint axes.

        Args:
            q: joint positions, (..., n) [rad, m].
            points: block diagonal matrix, (4 B, 4 B) for B bodies. The 4 x 4 block of a body has a column
                (position, 1) * sqrt(mass) for each of the four point masses that represent the body (see
                the class), in the body frame [m kg^(1/2), kg^(1/2)].
        """
        # Joint displacements of all bodies; the displacement of a mimic joint is linear in q of its leader.
        value = q @ self.ratios.mT + self.offset
        features = torch.cat([value.cos(), value.sin(), value], dim=-1)
        # Frames of the bodies relative to their parents: one matrix product for all bodies.
        relative = torch.unflatten(F.linear(features, self.table, self.fixed), -1, (-1, 4, 4)).unbind(dim=-3)
        # Parents precede their children, so the frame of a parent in the base frame is known.
        placed: list[Tensor] = []
        for index, parent in enumerate(self.parents):
            placed.append(relative[index] if parent < 0 else placed[parent] @ relative[index])
        frames = torch.cat(placed, dim=-1)
        z, origin = torch.unflatten(frames[..., :3, :], -1, (-1, 4))[..., 2:].unbind(dim=-1)
        angular = self.turns * z
        # The twist of a unit rate is (z, origin x z) for a rotation, (0, z) for a translation.
        axes = torch.cat([angular, torch.linalg.cross(origin, angular, dim=-2) + (z - angular)], dim=-2)
        points = frames @ points
        # Velocity of every point mass per unit rate of every joint. The mask `carried` sets the velocity to
        # zero for points that the joint does not carry.
        motions = torch.unflatten(axes.mT @ self.motions, -1, (3, 4)).flatten(-3, -2) @ points
        jacobian = torch.unflatten(motions, -2, (-1, 3)).flatten(-2) * self.carried
        place, mass = torch.unflatten(points, -1, (-1, 4)).tensor_split((3,), dim=-3)
        return ChainConfiguration(place, mass, axes, jacobian, (self.base * mass).flatten(-3))

    def motion(self, cache: ChainConfiguration, qd: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return velocities of bodies and point masses (see the class) at qd, (..., n) [rad/s, m/s].

        cache: configuration cache at q.

        Returns:
            velocities of the four point masses of each body times sqrt(mass), (..., 3, bodies, 4); twists
            of the bodies, (..., 6, bodies); time derivatives of the joint axes, (..., 6, bodies)
            (Featherstone, eq. 2.31).
        """
        rates = qd @ self.ratios.mT
        # The velocity of a body is the sum of the contributions of the joints that carry the body. The
        # Jacobian is zero for all other joints; in the sum of twists, the mask `carriers`, (bodies,
        # bodies), excludes them.
        velocity = torch.unflatten(applied(cache.jacobian.mT, rates), -1, (3, -1, 4))
        twists = (cache.axes * rates.unsqueeze(-2)) @ self.carriers
        (w, u), (a, m) = twists.chunk(2, dim=-2), cache.axes.chunk(2, dim=-2)
        # The axis of a joint is a twist (a, m) per unit rate: a is the angular velocity, m the linear
        # velocity at the origin of the base. If the axis moves with the twist (w, u), also (angular,
        # linear), its time derivative is (w x a, w x m + u x a).
        linear = torch.linalg.cross(w, m, dim=-2) + torch.linalg.cross(u, a, dim=-2)
        return velocity, twists, torch.cat([torch.linalg.cross(w, a, dim=-2), linear], dim=-2)

    def accelerations(self, cache: ChainConfiguration, qd: Tensor) -> Tensor:
        """Return sqrt(mass) (a - g) of the point masses of the bodies, at joint accelerations qdd = 0.

        a is the acceleration of a point mass and g the acceleration of gravity. ``cache.jacobian`` times
        the returned vector is the Coriolis, centrifugal and gravity torque at the joint of each body. The
        product of ``ratios``^T, (n, bodies), and this torque is the torque of the n joints, in which the
        torques of mimic joints are added to their leaders.

        Args:
            cache: configuration cache at q.
            qd: joint velocities, (..., n) [rad/s, m/s].

        Returns:
            (..., 12 bodies) [m/s^2 kg^(1/2)]: 3 coordinates of 4 point masses per body.
        """
        velocity, twists, turning = self.motion(cache, qd)
        steady = (turning * (qd @ self.ratios.mT).unsqueeze(-2)) @ self.carriers
        w, (a, u) = twists[..., :3, :, None], steady.unsqueeze(-1).chunk(2, dim=-3)
        # A point p of a body with twist (w, u0) and velocity v has the acceleration w x v + a x p + u, where
        # (a, u) is the time derivative of the twist, here at constant joint rates; a is angular.
        turned = torch.linalg.cross(w, velocity, dim=-3) + torch.linalg.cross(a, cache.place, dim=-3)
        return torch.addcmul(turned, u, cache.mass).flatten(-3) + cache.weight

    def kinetic_gradient(self, cache: ChainConfiguration, qd: Tensor) -> Tensor:
        """Return the gradient of 1/2 qd^T M(q) qd with respect to q at constant qd, (..., n) [Nm, N].

        cache: configuration cache at q. qd: joint velocities, (..., n) [rad/s, m/s].
        """
        velocity, _, turning = self.motion(cache, qd)
        # Angular momentum about the origin of the base, and linear momentum, of each point mass.
        momenta = [torch.linalg.cross(cache.place, velocity, dim=-3), cache.mass * velocity]
        # The derivative of the kinetic energy with respect to the displacement of joint i is h_i .
        # da_i/dt, a product of 6-vectors (angular, linear). h_i is the momentum of all bodies that joint
        # i carries, and a_i the twist of joint i per unit rate, with the time derivative da_i/dt. The
        # displacement also rotates the velocity v of each carried point about the axis w of the joint,
        # which does not change the energy: (w x v) . v = 0.
        carried = torch.cat(momenta, dim=-3).sum(dim=-1) @ self.carriers.mT
        return (turning * carried).sum(dim=-2) @ self.ratios


def chain_of_links(joints: Sequence[Joint], links: Sequence[Link], gravity: Row) -> BodyChain:
    """Return the ``BodyChain`` of an arm with these joints and links.

    gravity: gravitational acceleration in the base frame, (3,) [m/s^2].
    """
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
    """Return the upper triangular factor T of the pseudo-inertia C T T^T C^T of a body, (..., 4, 4).

    C C^T is the initial pseudo-inertia of the body (see ``InertialParameters``). T is diag(s) (1 + U),
    with the elements U of ``parameters`` above the diagonal. From the parameters d_1 ... d_4 on the
    diagonal, s_i = exp(d_i + d_4 / 2) for i < 4, and s_4 = exp(d_4 / 2).

    Args:
        parameters: log-Cholesky parameters as an upper triangular matrix, (..., 4, 4): logarithms of
            three extents and of the mass on the diagonal, shears and displacement of the center of mass
            above it.
    """
    logarithms = parameters.diagonal(dim1=-2, dim2=-1)
    sizes, mass = logarithms[..., :3], logarithms[..., 3:] / 2
    scale = torch.cat([sizes + mass, mass], dim=-1).exp()
    return scale.unsqueeze(-1) * (parameters.triu(1) + torch.eye(4).to(parameters))


def pseudo_inertia(link: Link) -> Tensor:
    """Return the pseudo-inertia [[S, m c], [(m c)^T, m]] of a link in the link's joint frame, (4, 4).

    With the mass m [kg], the center of mass c [m], the inertia tensor I about c [kg m^2] and the identity
    matrix E, S = tr(I)/2 E - I + m c c^T is the matrix of the second moments of mass.
    """
    xx, xy, xz, yy, yz, zz = link.inertia
    inertia = torch.tensor([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], dtype=torch.float64)
    center = torch.tensor([*link.center_of_mass, 1.0], dtype=torch.float64)
    pseudo = link.mass * torch.outer(center, center)
    pseudo[:3, :3] += inertia.trace() / 2 * torch.eye(3, dtype=torch.float64) - inertia
    return pseudo


class InertialParameters(nn.Module):
    """Inertial parameters of all bodies, physically consistent for any values of the trained parameters.

    The pseudo-inertia of a body is [[S, m c], [(m c)^T, m]] with mass m, center of mass c and second moments
    of mass S in the joint frame. It is computed as C T T^T C^T with upper triangular C and T. C C^T is the
    pseudo-inertia of the link in ``links`` (initial value). T is a function of the ten trained log-Cholesky
    parameters of the body (Rucker and Wensing, IEEE RA-L 7:4352, 2022): the logarithms of its mass and of its
    extents along three axes, relative to the initial values, and three shears and the displacement of the
    center of mass, in units of the extents. All parameters are initially zero, so that T is the identity.
    """

    parameter_groups = (("raw", "bodies", "kg, kg m, kg m^2"),)

    def __init__(self, links: Sequence[Link]) -> None:
        super().__init__()
        # `triangle`: linear map, (10, 16), from the entries of an upper triangle, in row-major order, to the
        # flattened 4 x 4 matrix.
        row, column = torch.triu_indices(4, 4)
        self.triangle = nn.Buffer(torch.eye(16, dtype=torch.float64)[4 * row + column])
        pseudo = torch.stack([pseudo_inertia(link) for link in links])
        # An upper triangular C with C C^T = P is needed, but torch computes L L^T with a lower triangular
        # L. Therefore the rows and columns of P are reversed, L is computed, and its rows and columns are
        # reversed.
        self.factors = nn.Buffer(torch.linalg.cholesky(pseudo.flip(-1, -2)).flip(-1, -2))
        self.raw = nn.Parameter(torch.zeros(len(links), 10, dtype=torch.float64))

    def forward(self) -> Tensor:
        """Return four point masses for each body, (bodies, 4, 4), which have the body's pseudo-inertia.

        They are the columns of the factor C T of the pseudo-inertia C T T^T C^T (see the class). A column
        is (position, 1) * sqrt(mass), in the joint frame [m kg^(1/2), kg^(1/2)].
        """
        return self.factors @ body_factor(torch.unflatten(self.raw @ self.triangle, -1, (4, 4)))
