"""Physically consistent inertial parameters of rigid bodies."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from spelgen.runtime.rows import Link


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
