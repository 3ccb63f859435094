"""Rigid bodies: their geometry, and inertial parameters that some distribution of mass has."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from spelgen.runtime.joints import vector
from spelgen.runtime.parts import Row, Rows


def skew(a: Tensor) -> Tensor:
    """[a]x, (..., 3, 3), with [a]x b = a x b."""
    x, y, z = a.unbind(dim=-1)
    zero = torch.zeros_like(x)
    entries = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1)
    return torch.unflatten(entries, -1, (3, 3))


def crossed(twists: Tensor, axes: Tensor) -> Tensor:
    """Return how axes carried along by ``twists`` change, (..., 6, k) (Featherstone 2008, eq. 2.31)."""
    (w, u), (a, m) = twists.chunk(2, dim=-2), axes.chunk(2, dim=-2)
    linear = torch.linalg.cross(w, m, dim=-2) + torch.linalg.cross(u, a, dim=-2)
    return torch.cat([torch.linalg.cross(w, a, dim=-2), linear], dim=-2)


def pushed_along(twists: Tensor, momenta: Tensor) -> Tensor:
    """Return how momenta carried along by ``twists`` change, (..., 6, k) (Featherstone, eq. 2.32)."""
    (w, u), (n, f) = twists.chunk(2, dim=-2), momenta.chunk(2, dim=-2)
    angular = torch.linalg.cross(w, n, dim=-2) + torch.linalg.cross(u, f, dim=-2)
    return torch.cat([angular, torch.linalg.cross(w, f, dim=-2)], dim=-2)


def motion_table(revolute: Sequence[bool], rotation: Sequence[Rows], position: Rows) -> tuple[Tensor, Tensor]:
    """Return what takes cos, sin and value of displacements to what takes twists from parents' frames.

    (36 bodies, 3 bodies), and what is added, (36 bodies,).
    """
    count, identity = len(revolute), torch.eye(6, dtype=torch.float64)
    table = torch.zeros(count, 6, 6, 3, count, dtype=torch.float64)
    fixed = torch.zeros(count, 6, 6, dtype=torch.float64)
    for index, turns in enumerate(revolute):
        # (w, v) at the frame of a body that has not moved
        turn = torch.stack([vector(row) for row in rotation[index]]).mT
        start = torch.ops.aten.block_diag([turn, turn])
        start[3:, :3] = -turn @ skew(vector(position[index]))
        # to turn by x takes it to (1 + sin x rate + (1 - cos x) rate^2) start, to slide to (1 + x rate) start
        rate = -crossed(identity[:, 2:3] if turns else identity[:, 5:], identity)
        square = rate @ rate @ start
        table[index, :, :, 0, index] = -square.mT
        table[index, :, :, 1 if turns else 2, index] = (rate @ start).mT
        fixed[index] = (start + square).mT
    return table.reshape(36 * count, 3 * count), fixed.flatten()


def spatial_inertia(ten: Tensor) -> Tensor:
    """Return [[I, [m c]x], [-[m c]x, m]], (..., 6, 6), of (m, m c, I), (..., 10)."""
    m, _, _, _, xx, xy, xz, yy, yz, zz = ten.unbind(dim=-1)
    inertia = torch.unflatten(torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], dim=-1), -1, (3, 3))
    moment, mass = skew(ten[..., 1:4]), m[..., None, None] * torch.eye(3).to(ten)
    return torch.cat([torch.cat([inertia, moment], dim=-1), torch.cat([-moment, mass], dim=-1)], dim=-2)


def pseudo_inertia(ten: Tensor) -> Tensor:
    """[[tr(I)/2 - I, m c], [(m c)^T, m]], (..., 4, 4), of (m, m c, I), (..., 10).

    It is positive definite exactly where some distribution of mass has these parameters (Wensing,
    Kim and Slotine, IEEE RA-L 3:60, 2018).
    """
    m, x, y, z, xx, xy, xz, yy, yz, zz = ten.unbind(dim=-1)
    half = (xx + yy + zz) / 2
    rows = [half - xx, -xy, -xz, x, -xy, half - yy, -yz, y, -xz, -yz, half - zz, z, x, y, z, m]
    return torch.stack(rows, dim=-1).reshape(*ten.shape[:-1], 4, 4)


def upper_cholesky(matrix: Tensor) -> Tensor:
    """Return the upper triangular U, (..., n, n), with U U^T the matrix."""
    lower: Tensor = torch.linalg.cholesky(matrix.flip(-1, -2))
    return lower.flip(-1, -2)


def body_factor(weights: Tensor) -> Tensor:
    """Return T of a body's log-Cholesky parameters, both upper triangular, (..., 4, 4)."""
    logarithms = weights.diagonal(dim1=-2, dim2=-1)
    sizes, mass = logarithms[..., :3], logarithms[..., 3:] / 2
    scale = torch.cat([sizes + mass, mass], dim=-1).exp()
    return scale.unsqueeze(-1) * (weights.triu(1) + torch.eye(4).to(weights))


class InertialParameters(nn.Module):
    """Trained inertial parameters of rigid bodies, possible ones for all weights; zero is nominal.

    A body's pseudo-inertia is C T T^T C^T, with C and T upper triangular, and C of the nominal body.
    T has the body's log-Cholesky parameters (Rucker and Wensing, IEEE RA-L 7:4352, 2022): logarithms
    of its mass and of its sizes along three axes, by the nominal ones, and its shear and centre of
    mass, in its sizes.
    """

    kinds = (("raw", "bodies", "kg, kg m, kg m^2"),)

    def __init__(self, *inertia: Row) -> None:
        super().__init__()
        nominal = torch.stack([vector(ten) for ten in inertia])
        self.factors = nn.Buffer(upper_cholesky(pseudo_inertia(nominal)))
        row, column = torch.triu_indices(4, 4)
        self.triangle = nn.Buffer(torch.eye(16, dtype=torch.float64)[4 * row + column])
        self.raw = nn.Parameter(torch.zeros(len(nominal), 10, dtype=torch.float64))

    def forward(self) -> Tensor:
        """Return, by body, (m, m c, Ixx, Ixy, Ixz, Iyy, Iyz, Izz) about its joint's frame, (bodies, 10)."""
        root = self.factors @ body_factor(torch.unflatten(self.raw @ self.triangle, -1, (4, 4)))
        pseudo = root @ root.mT
        second = pseudo[..., :3, :3]
        trace = second.diagonal(dim1=-2, dim2=-1).sum(dim=-1)
        inertia = trace[..., None, None] * torch.eye(3).to(pseudo) - second
        row, column = torch.triu_indices(3, 3)
        return torch.cat([pseudo[..., 3, 3:], pseudo[..., 3, :3], inertia[..., row, column]], dim=-1)
