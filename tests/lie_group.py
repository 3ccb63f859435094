"""Port-Hamiltonian equations of an arm with a rotation matrix in SO(3), or a position in R^3, for each joint.

They are the equations of Wang, Chen and Ding, Sci Rep 15:33179, 2025 (in this file: the paper). The emitted module has
one coordinate per joint instead: tests check that its rates equal the rates of these equations.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch


def to_group(joint_types: Sequence[str], q: torch.Tensor) -> list[torch.Tensor]:
    """Convert q (..., n) to positions on the group, one per joint.

    Positions of turning joints are R in SO(3), (..., 3, 3), positions of sliding joints r in R^3, (..., 3) [m].
    """
    zero, one = torch.zeros_like(q), torch.ones_like(q)
    rows = [q.cos(), -q.sin(), zero, q.sin(), q.cos(), zero, zero, zero, one]
    rotations = torch.stack(rows, dim=-1).reshape(*q.shape, 3, 3)
    positions = torch.stack([zero, zero, q], dim=-1)
    elements = []
    for joint, kind in enumerate(joint_types):
        view = rotations if kind == "revolute" else positions
        elements.append(view.select(q.dim() - 1, joint))
    return elements


def from_group(joint_types: Sequence[str], elements: Sequence[torch.Tensor]) -> torch.Tensor:
    """Return q, (..., n), with angles in [-pi, pi], from the positions of `to_group`."""
    values = []
    for kind, element in zip(joint_types, elements, strict=True):
        if kind == "revolute":
            values.append(torch.atan2(element[..., 1, 0], element[..., 0, 0]))
        else:
            values.append(element[..., 2])
    return torch.stack(values, dim=-1)


class GroupModel(Protocol):
    """Protocol of the models that `group_rates` accepts: attributes and methods of `Model` in emitted modules."""

    joint_types: tuple[str, ...]

    def hamiltonian(self, q: torch.Tensor, p: torch.Tensor) -> torch.Tensor: ...

    def dissipation(self, q: torch.Tensor, qd: torch.Tensor) -> torch.Tensor: ...

    def input_matrix(self, q: torch.Tensor) -> torch.Tensor: ...


def geodesic_distance(left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    """Return the angle, (...,) [rad], of the rotation from R = ``left`` to R' = ``right``, (..., 3, 3) each.

    It is |log(R^T R')| / sqrt(2), eq. 8 of the paper (see the module). It is computed as the arc tangent of sine and
    cosine, which is exact for small angles, too; an arc cosine would lose half its digits.
    """
    turn = left.mT @ right
    axis = torch.stack(
        [
            turn[..., 2, 1] - turn[..., 1, 2],
            turn[..., 0, 2] - turn[..., 2, 0],
            turn[..., 1, 0] - turn[..., 0, 1],
        ],
        dim=-1,
    )
    return torch.atan2(axis.norm(dim=-1), torch.diagonal(turn, dim1=-2, dim2=-1).sum(dim=-1) - 1)


def group_rates(
    model: GroupModel, parts: Sequence[torch.Tensor], p: torch.Tensor, tau: torch.Tensor
) -> tuple[list[torch.Tensor], torch.Tensor]:
    """Return the rates of each joint's position on the group, and of all momenta, by eq. 15 and 18 of the paper.

    parts: position of each joint (see `to_group`), a rotation matrix R or a vector r. p: momenta in joint frames,
    (..., n, 3). tau: inputs, (..., n). The paper is Wang, Chen and Ding, see the module. The first line is for a
    turning joint, with the rows r_1, r_2, r_3 of R, the second line for a sliding joint:

        r_j' = r_j x dH/dp,  p' = p x dH/dp + sum_j r_j x dH/dr_j - D dH/dp + G tau
        r' = dH/dp,          p' = -dH/dr - D dH/dp + G tau

    dH/dR and dH/dr are automatic derivatives with respect to all entries of R and r. A joint moves about or along
    its z axis only, since its bearing blocks the x and y axes: H, D and G act only on the z components.
    """
    with torch.enable_grad():
        places = [part.detach().requires_grad_() for part in parts]
        momenta = p.detach().requires_grad_()
        energy = model.hamiltonian(from_group(model.joint_types, places), momenta[..., 2])
        *slopes, velocity = torch.autograd.grad(energy.sum(), (*places, momenta), materialize_grads=True)
    q, qd = from_group(model.joint_types, list(parts)), velocity[..., 2]
    moving = model.input_matrix(q) @ tau.unsqueeze(-1) - model.dissipation(q, qd) @ qd.unsqueeze(-1)
    rates, forces = [], []
    for i, (part, slope) in enumerate(zip(parts, slopes, strict=True)):
        # A rotation, (..., 3, 3), of a turning joint has as many dimensions as p, (..., n, 3). A position, (..., 3), of
        # a sliding joint has one less.
        turning = part.dim() == p.dim()
        rate, force = (_turning if turning else _sliding)(part, slope, p[..., i, :], velocity[..., i, :])
        rates.append(rate)
        forces.append(force + torch.nn.functional.pad(moving[..., i, :], (2, 0)))
    return rates, torch.stack(forces, dim=-2)


def _turning(
    rotation: torch.Tensor, slope: torch.Tensor, p: torch.Tensor, velocity: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return dR/dt, (..., 3, 3), and the conservative part of dp/dt, (..., 3), of a turning (revolute) joint.

    The caller `group_rates` adds the dissipation -D dH/dp and the input G tau to dp/dt. rotation: R, (..., 3, 3).
    slope: dH/dR, (..., 3, 3). p: momentum in the joint frame, (..., 3). velocity: dH/dp, (..., 3).
    """
    rate = torch.linalg.cross(rotation, velocity.unsqueeze(-2).expand_as(rotation), dim=-1)
    torque = torch.linalg.cross(p, velocity, dim=-1) + torch.linalg.cross(rotation, slope, dim=-1).sum(dim=-2)
    return rate, torque


def _sliding(
    position: torch.Tensor, slope: torch.Tensor, p: torch.Tensor, velocity: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return dr/dt and the conservative part of dp/dt, (..., 3) each, of a sliding (prismatic) joint.

    The caller `group_rates` adds the dissipation -D dH/dp and the input G tau to dp/dt. slope: dH/dr, (..., 3).
    velocity: dH/dp, (..., 3). position and p have no effect.
    """
    return velocity, -slope
