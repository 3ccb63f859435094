"""PHNODE as in its published code, for comparison in `benchmarks/training_step.py` only.

Duong, Altawaitan, Stanley, Atanasov, Port-Hamiltonian Neural ODE Networks on Lie Groups (IEEE T-RO 40:3695,
2024), carried over to a chain of n joints as Wang, Chen, Ding (Sci Rep 15:33179, 2025) do for their baseline.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.func import jvp


def _mlp(inputs: int, width: int, outputs: int) -> nn.Sequential:
    """A tanh network with two hidden layers and orthogonal weights."""
    sizes = (inputs, width, width, outputs)
    layers: list[nn.Module] = []
    for below, above in pairwise(sizes):
        linear = nn.Linear(below, above, dtype=torch.float64)
        nn.init.orthogonal_(linear.weight)
        layers += [linear, nn.Tanh()]
    return nn.Sequential(*layers[:-1])


class _Cholesky(nn.Module):
    """Positive definite matrix L L^T + eps I, with the lower triangle L from a network."""

    def __init__(self, inputs: int, width: int, size: int, epsilon: float) -> None:
        super().__init__()
        self.network = _mlp(inputs, width, size * (size + 1) // 2)
        self.row, self.column = torch.tril_indices(size, size)
        self.least = epsilon * torch.eye(size, dtype=torch.float64)

    def forward(self, x: Tensor) -> Tensor:
        y = self.network(x)
        lower = y.new_zeros(*y.shape[:-1], *self.least.shape)
        lower[..., self.row, self.column] = y
        return lower @ lower.mT + self.least


class Published(nn.Module):
    """Published PHNODE of n revolute joints, each modelled like a spherical joint: rates of (R, zeta), (..., 12 n).

    R: rotation matrix of each joint, zeta: its angular velocity about all three axes of the joint frame, (3,). The
    rates of R and of the momenta p = M zeta are eq. 18 of Wang, Chen and Ding. Every derivative is automatic: dH/dR and
    dH/dp in one call, and dM^-1/dt one entry at a time.
    """

    def __init__(self, joints: int, width: int, potential_width: int) -> None:
        super().__init__()
        self.n, rotations, axes = joints, 9 * joints, 3 * joints
        self.inverse_mass = _Cholesky(rotations, width, axes, 0.1)
        self.dissipation = _Cholesky(rotations + axes, width, axes, 0.0)
        self.potential = _mlp(rotations, potential_width, 1)
        self.gains = _mlp(rotations, width, axes)

    def forward(self, state: Tensor, tau: Tensor) -> Tensor:
        state = state if state.requires_grad else state.requires_grad_()
        rotation, zeta = state.split((9 * self.n, 3 * self.n), dim=-1)
        p = torch.linalg.solve(self.inverse_mass(rotation), zeta.unsqueeze(-1)).squeeze(-1)
        # from here on R and p are independent variables, so that each partial derivative of H keeps the other constant
        rotation, p = torch.cat([rotation, p], dim=-1).split((9 * self.n, 3 * self.n), dim=-1)
        inverse = self.inverse_mass(rotation)
        kinetic = 0.5 * (p * (inverse @ p.unsqueeze(-1)).squeeze(-1)).sum(dim=-1)
        energy = kinetic + self.potential(rotation).squeeze(-1)
        by_rotation, by_p = torch.autograd.grad(energy.sum(), (rotation, p), create_graph=True)
        rows, slopes = (x.unflatten(-1, (self.n, 3, 3)) for x in (rotation, by_rotation))
        spin = by_p.unflatten(-1, (self.n, 3))
        rotation_rate = torch.linalg.cross(rows, spin.unsqueeze(-2).expand_as(rows)).flatten(-3)
        force = torch.linalg.cross(p.unflatten(-1, (self.n, 3)), spin)
        force = (force + torch.linalg.cross(rows, slopes).sum(dim=-2)).flatten(-2)
        force = force - (self.dissipation(state) @ by_p.unsqueeze(-1)).squeeze(-1)
        force = force + (self.gains(rotation).unflatten(-1, (self.n, 3)) * tau.unsqueeze(-1)).flatten(-2)
        inverse_rate = self._rate(inverse, rotation, rotation_rate)
        zeta_rate = inverse @ force.unsqueeze(-1) + inverse_rate @ p.unsqueeze(-1)
        return torch.cat([rotation_rate, zeta_rate.squeeze(-1)], dim=-1)

    def _rate(self, inverse: Tensor, rotation: Tensor, rotation_rate: Tensor) -> Tensor:
        rate = torch.zeros_like(inverse)
        for i in range(3 * self.n):
            for j in range(3 * self.n):
                entry = inverse[..., i, j].sum()
                (slope,) = torch.autograd.grad(entry, rotation, create_graph=True)
                rate[..., i, j] = (slope * rotation_rate).sum(dim=-1)
        return rate


class ByJvp(Published):
    """PHNODE with one change: dM^-1/dt is one derivative along the motion (torch.func.jvp), not one per entry."""

    def _rate(self, inverse: Tensor, rotation: Tensor, rotation_rate: Tensor) -> Tensor:
        rate: Tensor = jvp(self.inverse_mass, (rotation,), (rotation_rate,))[1]
        return rate
