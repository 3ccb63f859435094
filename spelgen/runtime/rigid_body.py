"""Inertial parameters that some distribution of mass has."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from spelgen.runtime.parts import Row


def body_factor(weights: Tensor) -> Tensor:
    """Return T of a body's log-Cholesky parameters, both upper triangular, (..., 4, 4)."""
    logarithms = weights.diagonal(dim1=-2, dim2=-1)
    sizes, mass = logarithms[..., :3], logarithms[..., 3:] / 2
    scale = torch.cat([sizes + mass, mass], dim=-1).exp()
    return scale.unsqueeze(-1) * (weights.triu(1) + torch.eye(4).to(weights))


class InertialParameters(nn.Module):
    """Trained inertial parameters of rigid bodies, possible ones for all weights; zero is nominal.

    A body's pseudo-inertia is [[S, m c], [(m c)^T, m]], S the second moments of mass about its joint's frame.
    It is C T T^T C^T, with C and T upper triangular, and C of the nominal body. T has the body's
    log-Cholesky parameters (Rucker and Wensing, IEEE RA-L 7:4352, 2022): logarithms of its mass and of its
    sizes along three axes, by the nominal ones, and its shear and centre of mass, in its sizes.
    """

    kinds = (("raw", "bodies", "kg, kg m, kg m^2"),)

    def __init__(self, *nominal: Row) -> None:
        super().__init__()
        # where the numbers of an upper triangle stand in a matrix, row by row
        row, column = torch.triu_indices(4, 4)
        self.triangle = nn.Buffer(torch.eye(16, dtype=torch.float64)[4 * row + column])
        pseudo = torch.unflatten(torch.tensor(nominal, dtype=torch.float64) @ self.triangle, -1, (4, 4))
        pseudo = pseudo + pseudo.triu(1).mT
        # as lower triangular ones, of all rows and columns in reverse
        self.factors = nn.Buffer(torch.linalg.cholesky(pseudo.flip(-1, -2)).flip(-1, -2))
        self.raw = nn.Parameter(torch.zeros(len(nominal), 10, dtype=torch.float64))

    def forward(self) -> Tensor:
        """Return C T of each body, (bodies, 4, 4): its columns are points that move as its mass does."""
        return self.factors @ body_factor(torch.unflatten(self.raw @ self.triangle, -1, (4, 4)))
