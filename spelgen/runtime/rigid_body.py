"""Rigid bodies: their geometry, and inertial parameters that some distribution of mass has."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from spelgen.runtime.joints import vector
from spelgen.runtime.parts import Row


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

    def roots(self) -> Tensor:
        """Return, by body, a root of its pseudo-inertia, upper triangular, (bodies, 4, 4)."""
        return self.factors @ body_factor(torch.unflatten(self.raw @ self.triangle, -1, (4, 4)))

    def forward(self) -> Tensor:
        """Return, by body, (m, m c, Ixx, Ixy, Ixz, Iyy, Iyz, Izz) about its joint's frame, (bodies, 10)."""
        root = self.roots()
        pseudo = root @ root.mT
        second = pseudo[..., :3, :3]
        trace = second.diagonal(dim1=-2, dim2=-1).sum(dim=-1)
        inertia = trace[..., None, None] * torch.eye(3).to(pseudo) - second
        row, column = torch.triu_indices(3, 3)
        return torch.cat([pseudo[..., 3, 3:], pseudo[..., 3, :3], inertia[..., row, column]], dim=-1)
