"""How the bodies of an arm may move: their frames along the chain, and what velocities make of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.joints import vector
from spelgen.runtime.parts import Row, Rows
from spelgen.runtime.port_hamiltonian import applied
from spelgen.runtime.rigid_body import crossed, motion_table, pushed_along


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

    def __init__(
        self,
        n: int,
        gravity: Row,
        parent: Sequence[int],  # of each body; -1: the base
        joint: Sequence[int],
        revolute: Sequence[bool],  # whether a body turns about its frame's z, or slides along it,
        ratio: Row,  # by ratio * q + offset
        offset: Row,
        rotation: Sequence[Rows],  # of the joint's frame in its parent's
        position: Rows,  # likewise [m]
    ) -> None:
        super().__init__()
        self.parents, count = parent, len(parent)
        reading = torch.zeros(count, 6, count, dtype=torch.float64)
        carriers = torch.eye(count, dtype=torch.float64)
        ratios = torch.zeros(count, n, dtype=torch.float64)
        for index, carrier in enumerate(parent):
            ratios[index, joint[index]] = ratio[index]
            # an inverse's rows are columns whose halves are swapped
            reading[index, 5 if revolute[index] else 2, index] = 1
            if carrier >= 0:
                carriers[:, index] += carriers[:, carrier]
        table, fixed = motion_table(revolute, rotation, position)
        self.table = nn.Buffer(table)  # see ``motion_table``
        self.fixed = nn.Buffer(fixed)
        # where axes stand in ``frames``, (6 bodies, bodies)
        self.reading = nn.Buffer(reading.flatten(0, 1))
        self.carriers = nn.Buffer(carriers)  # whether a body carries another, or is it, (bodies, bodies)
        # likewise, six times each, (bodies, 6 bodies)
        self.carried = nn.Buffer(carriers.repeat_interleave(6, dim=1))
        # acceleration of the base that stands for gravity, (6,)
        self.base = nn.Buffer(vector((0, 0, 0, *(-g for g in gravity))))
        # displacements are ratios q + offset, (bodies, n) and (bodies,)
        self.ratios, self.offset = nn.Buffer(ratios), nn.Buffer(vector(offset))

    def forward(self, q: Tensor) -> Chain:
        """The bodies at q, (..., n)."""
        value = q @ self.ratios.mT + self.offset
        features = torch.cat([value.cos(), value.sin(), value], dim=-1)
        relative = torch.unflatten(F.linear(features, self.table, self.fixed), -1, (-1, 6, 6)).unbind(dim=-3)
        placed: list[Tensor] = []
        for index, parent in enumerate(self.parents):
            placed.append(relative[index] if parent < 0 else placed[parent] @ relative[index])
        frames = torch.cat(placed, dim=-1)
        axes = (frames @ self.reading).roll(3, dims=-2)
        twists = self.ratios.mT @ ((axes.mT @ frames) * self.carried)
        return Chain(frames, axes, twists, self.base @ frames)

    def turning(self, pose: Chain, qd: Tensor) -> tuple[Tensor, Tensor]:
        """The bodies' twists, and how these turn the bodies' axes; in the base's frame, (..., 6, bodies)."""
        twists = (pose.axes * (qd @ self.ratios.mT).unsqueeze(-2)) @ self.carriers
        return twists, crossed(twists, pose.axes)

    def accelerations(self, pose: Chain, qd: Tensor, turning: Tensor) -> Tensor:
        """The bodies' accelerations at steady qd, gravity taken as one, (..., 6 bodies)."""
        steady = (turning * (qd @ self.ratios.mT).unsqueeze(-2)) @ self.carriers
        bodies = torch.unflatten(pose.frames, -1, (-1, 6)) * steady.unsqueeze(-1)
        return bodies.sum(dim=-3).flatten(-2) + pose.weight

    def at_base(self, pose: Chain, momenta: Tensor) -> Tensor:
        """Momenta of the bodies, (..., 6 bodies), in the base's frame, (..., 6, bodies)."""
        return torch.unflatten(pose.frames * momenta.unsqueeze(-2), -1, (-1, 6)).sum(dim=-1)

    def by_joints(self, axes: Tensor, wrenches: Tensor) -> Tensor:
        """What joints feel along ``axes`` of wrenches on all that they carry, (..., n)."""
        return (axes * (wrenches @ self.carriers.mT)).sum(dim=-2) @ self.ratios

    def steady_torque(self, pose: Chain, qd: Tensor, momenta: Tensor) -> Tensor:
        """Return the torque that holds qd steady, (..., n), by Newton and Euler.

        momenta: of the chain's twists, by joint velocity, (..., n, 6 bodies).
        """
        twists, turning = self.turning(pose, qd)
        rising = applied(momenta, self.accelerations(pose, qd, turning))
        pushed = pushed_along(twists, self.at_base(pose, applied(momenta.mT, qd)))
        return rising + self.by_joints(pose.axes, pushed)
