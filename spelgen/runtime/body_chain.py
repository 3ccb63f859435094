"""How the bodies of an arm may move: where their masses are along the chain, and what velocities make of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.joints import vector
from spelgen.runtime.parts import Row, Rows
from spelgen.runtime.port_hamiltonian import applied


class Chain(NamedTuple):
    """The bodies at a position, each as four points, in the base's frame and times roots of their masses."""

    place: Tensor  # (..., 3, bodies, 4)
    mass: Tensor  # the roots, (..., 1, bodies, 4)
    axes: Tensor  # twists that bodies have by their own displacements, (..., 6, bodies)
    jacobian: Tensor  # of the points by the bodies' displacements, (..., bodies, 12 bodies)
    weight: Tensor  # acceleration of the points that stands for gravity, (..., 12 bodies)


class BodyChain(nn.Module):
    """Bodies that turn about or slide along axes, each carried by another or by the base.

    Twists are (angular, linear) in the base's frame, as in Featherstone, Rigid Body Dynamics Algorithms,
    2008; frames are 4 x 4 (Uicker, J. Appl. Mech. 34:418, 1967). A body moves as four points do, the columns
    (position, 1) root of mass of a root of its pseudo-inertia. Only frames are followed body by body: sums
    over all that carries a body, or that it carries, are products with a mask, so few operations are left.
    """

    def __init__(
        self,
        n: int,
        gravity: Row,
        parent: Sequence[int],  # of each body; -1: the base
        joint: Sequence[int],
        revolute: Sequence[bool],  # whether a body turns about its frame's z, or slides along it,
        ratio: Row,  # by ratio * q + offset
        offset: Row,
        placement: Sequence[Rows],  # of the joint's frame in its parent's: three rows of [R p], p in m
    ) -> None:
        super().__init__()
        self.parents, count, turns = parent, len(parent), vector(revolute)
        # displacements are ratios q + offset, (bodies, n) and (bodies,)
        self.ratios = nn.Buffer(vector(ratio).unsqueeze(-1) * torch.eye(n)[list(joint)])
        self.offset, self.turns = nn.Buffer(vector(offset)), nn.Buffer(turns)
        # to turn by x moves a frame by 1 + sin x rate + (1 - cos x) rate^2, to slide by 1 + x rate
        start, rate = torch.eye(4).double().repeat(count, 1, 1), torch.zeros(count, 4, 4).double()
        start[:, :3] = torch.tensor(placement, dtype=torch.float64)
        rate[:, 1, 0], rate[:, 0, 1], rate[:, 2, 3] = turns, -turns, 1 - turns
        first, second = (start @ rate).flatten(1), (start @ rate @ rate).flatten(1)
        by_feature = [-second, turns.unsqueeze(-1) * first, (1 - turns).unsqueeze(-1) * first]
        # what takes cos, sin and value of displacements to frames in parents', (16 bodies, 3 bodies)
        blocks = [torch.ops.aten.block_diag([*x.unsqueeze(-1)]) for x in by_feature]
        self.table = nn.Buffer(torch.cat(blocks, dim=1))
        self.fixed = nn.Buffer((start.flatten(1) + second).flatten())  # what is added
        # what takes twists to 3 x 4 matrices, which take points to velocities, (6, 12)
        unit = torch.eye(3).double()
        skew = torch.linalg.cross(unit.unsqueeze(-1), unit.unsqueeze(0), dim=1)
        self.motions = nn.Buffer(
            torch.cat([F.pad(skew, (0, 1)), F.pad(unit.unsqueeze(-1), (3, 0))]).flatten(1)
        )
        carriers = torch.eye(count).double()
        for index, carrier in enumerate(parent):
            if carrier >= 0:
                carriers[:, index] += carriers[:, carrier]
        self.carriers = nn.Buffer(carriers)  # whether a body carries another, or is it, (bodies, bodies)
        # likewise, by numbers of the points, (bodies, 12 bodies)
        self.carried = nn.Buffer(carriers.repeat_interleave(4, dim=1).repeat(1, 3))
        # acceleration of the base that stands for gravity, (3, 1, 1)
        self.base = nn.Buffer(-vector(gravity)[:, None, None])

    def forward(self, q: Tensor, points: Tensor) -> Chain:
        """The bodies at q, (..., n); points in their own frames, (4 bodies, 4 bodies), zero but on blocks."""
        value = q @ self.ratios.mT + self.offset
        features = torch.cat([value.cos(), value.sin(), value], dim=-1)
        relative = torch.unflatten(F.linear(features, self.table, self.fixed), -1, (-1, 4, 4)).unbind(dim=-3)
        placed: list[Tensor] = []
        for index, parent in enumerate(self.parents):
            placed.append(relative[index] if parent < 0 else placed[parent] @ relative[index])
        frames = torch.cat(placed, dim=-1)
        z, origin = torch.unflatten(frames[..., :3, :], -1, (-1, 4))[..., 2:].unbind(dim=-1)
        angular = self.turns * z
        axes = torch.cat([angular, torch.linalg.cross(origin, angular, dim=-2) + (z - angular)], dim=-2)
        points = frames @ points
        motions = torch.unflatten(axes.mT @ self.motions, -1, (3, 4)).flatten(-3, -2) @ points
        jacobian = torch.unflatten(motions, -2, (-1, 3)).flatten(-2) * self.carried
        place, mass = torch.unflatten(points, -1, (-1, 4)).tensor_split((3,), dim=-3)
        return Chain(place, mass, axes, jacobian, (self.base * mass).flatten(-3))

    def motion(self, pose: Chain, qd: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Points' velocities, (..., 3, bodies, 4), twists, how these turn axes (Featherstone, eq. 2.31)."""
        rates = qd @ self.ratios.mT
        velocity = torch.unflatten(applied(pose.jacobian.mT, rates), -1, (3, -1, 4))
        twists = (pose.axes * rates.unsqueeze(-2)) @ self.carriers
        (w, u), (a, m) = twists.chunk(2, dim=-2), pose.axes.chunk(2, dim=-2)
        linear = torch.linalg.cross(w, m, dim=-2) + torch.linalg.cross(u, a, dim=-2)
        return velocity, twists, torch.cat([torch.linalg.cross(w, a, dim=-2), linear], dim=-2)

    def accelerations(self, pose: Chain, qd: Tensor) -> Tensor:
        """The points' accelerations at steady qd, gravity taken as one, (..., 12 bodies)."""
        velocity, twists, turning = self.motion(pose, qd)
        steady = (turning * (qd @ self.ratios.mT).unsqueeze(-2)) @ self.carriers
        w, (a, u) = twists[..., :3, :, None], steady.unsqueeze(-1).chunk(2, dim=-3)
        turned = torch.linalg.cross(w, velocity, dim=-3) + torch.linalg.cross(a, pose.place, dim=-3)
        return torch.addcmul(turned, u, pose.mass).flatten(-3) + pose.weight

    def kinetic_gradient(self, pose: Chain, qd: Tensor) -> Tensor:
        """Return d/dq of the kinetic energy at qd, (..., n)."""
        velocity, _, turning = self.motion(pose, qd)
        momenta = [torch.linalg.cross(pose.place, velocity, dim=-3), pose.mass * velocity]
        # of all that a body carries, by what its displacement adds to their twist
        carried = torch.cat(momenta, dim=-3).sum(dim=-1) @ self.carriers.mT
        return (turning * carried).sum(dim=-2) @ self.ratios
