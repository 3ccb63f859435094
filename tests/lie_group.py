"""The port-Hamiltonian equations of the paper on SO(3)^k x R^3^l, with three axes per joint.

The emitted module integrates one coordinate per joint. This file has the equations of the paper (Wang, Chen, Ding,
Sci Rep 15:33179, 2025), from rotation matrices to rates, to show that both are equal.
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
    """Methods of an emitted module that the equations on SO(3)^k x R^3^l use; shapes: docstrings of emitted modules."""

    joint_types: tuple[str, ...]

    def hamiltonian(self, q: torch.Tensor, p: torch.Tensor) -> torch.Tensor: ...

    def dissipation(self, q: torch.Tensor, qd: torch.Tensor) -> torch.Tensor: ...

    def input_matrix(self, q: torch.Tensor) -> torch.Tensor: ...


def geodesic_distance(left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    """Angle (...,) [rad] of the rotation from ``left`` to ``right``, (..., 3, 3): |log(R^T R')| / sqrt(2) of eq. 8.

    As the arc tangent of sine and cosine it is exact for small angles too, where an arc cosine loses half
    its digits.
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

    parts: position of each joint (see `to_group`), a rotation matrix R or a vector r. p: (..., n, 3) momenta in joint
    frames. tau: (..., n) input. A turning joint, with the rows r_1, r_2, r_3 of R, and then a sliding joint have:

        r_j' = r_j x dH/dp,  p' = p x dH/dp + sum_j r_j x dH/dr_j - D dH/dp + G u
        r' = dH/dp,          p' = -dH/dr - D dH/dp + G u

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
        # a turning joint has a rotation (..., 3, 3), a sliding joint a position (..., 3)
        turning = part.dim() == p.dim()
        rate, force = (_turning if turning else _sliding)(part, slope, p[..., i, :], velocity[..., i, :])
        rates.append(rate)
        forces.append(force + torch.nn.functional.pad(moving[..., i, :], (2, 0)))
    return rates, torch.stack(forces, dim=-2)


def _turning(
    rotation: torch.Tensor, slope: torch.Tensor, p: torch.Tensor, velocity: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return dR/dt and, without the terms of D and G, dp/dt, (..., 3), of a turning joint; see `group_rates`.

    rotation: R; slope: dH/dR; R and its derivatives are (..., 3, 3). velocity: dH/dp, (..., 3).
    """
    rate = torch.linalg.cross(rotation, velocity.unsqueeze(-2).expand_as(rotation), dim=-1)
    torque = torch.linalg.cross(p, velocity, dim=-1) + torch.linalg.cross(rotation, slope, dim=-1).sum(dim=-2)
    return rate, torque


def _sliding(
    position: torch.Tensor, slope: torch.Tensor, p: torch.Tensor, velocity: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return dr/dt and, without the terms of D and G, dp/dt, (..., 3) each, of a sliding joint; see `group_rates`.

    slope: dH/dr. velocity: dH/dp.
    """
    return velocity, -slope
