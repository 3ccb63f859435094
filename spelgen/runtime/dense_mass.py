"""M^-1(q) over all three axes of every joint, as if nothing were known of the arm."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.joints import Joints, vector
from spelgen.runtime.parts import Intermediates, Layers, Network


class DenseIntermediates(NamedTuple):
    """What M's derivatives need of the work done for M."""

    network: Intermediates
    factor: Tensor  # U
    moved: Tensor  # U^-1 A, with A the moving columns of C^-1
    scale: Tensor  # e


def nominal_factor(joints: Joints, mean: Sequence[Sequence[float]]) -> Tensor:
    """C, lower triangular: C C^T is the nominal mean of M^-1 over all axes, (3 n, 3 n).

    ``mean`` is the lower triangle of the nominal mean of M without armature. z of each joint
    moves; about its other axes a joint is taken to be as heavy as about z.
    """
    n = len(joints.speed)
    mass = torch.zeros(n, n, dtype=torch.float64)
    row, column = torch.tril_indices(n, n)
    mass[row, column] = mass[column, row] = vector(x for entries in mean for x in entries)
    mass += torch.diag(vector(joints.armature))
    everywhere = torch.diag(mass.diagonal().repeat_interleave(3))
    everywhere[2::3, 2::3] = mass
    factor: Tensor = torch.linalg.cholesky(torch.linalg.inv(everywhere))
    return factor


class DenseMass(nn.Module):
    """M(q), (..., n, n), from M^-1 = C U diag(e) U^T C^T over all axes, (3 n, 3 n).

    C is the Cholesky factor of the nominal mean, U lower triangular with ones on its diagonal and
    e > 0, both given by a network: the Cholesky factorisation without square roots. The bearings
    hold all axes but z still, so M is the moving block of the inverse:
    (U^-1 A)^T diag(1 / e) U^-1 A, where A is the moving columns of C^-1.
    """

    def __init__(self, joints: Joints, mean: Sequence[Sequence[float]], network: Network) -> None:
        super().__init__()
        self.size = 3 * len(joints.speed)
        factor = nominal_factor(joints, mean)
        self.nominal = nn.Buffer(factor)
        self.moving = nn.Buffer(torch.linalg.inv(factor)[:, 2::3])
        row, column = torch.tril_indices(self.size, self.size, -1)
        # where the entries below U's diagonal stand in U, row by row
        self.below = nn.Buffer(row * self.size + column)
        # so that U starts without entries below its diagonal, and e at one
        start = vector([0.0] * len(row) + [math.log(math.e - 1)] * self.size)
        self.start = nn.Buffer(start)
        self.network = network

    def prepare(self) -> Layers:
        """The network's weights made ready for many states."""
        return self.network.prepare(torch.diag(0 * self.start + 1), self.start)

    def inverse(self, encoded: Tensor, prepared: Layers) -> Tensor:
        """M^-1 over all three axes of every joint, of which z moves; (..., 3 n, 3 n)."""
        factor, scale = self._factor(self.network.forward(encoded, prepared)[0])
        lower = self.nominal @ (factor + torch.eye(self.size).to(factor))
        return (lower * scale.unsqueeze(-2)) @ lower.mT

    def _factor(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        """U, below its diagonal of ones, (..., 3 n, 3 n), and e, (..., 3 n)."""
        entries, scale = raw.tensor_split((len(self.below),), dim=-1)
        return self._lower(entries), F.softplus(scale)

    def _lower(self, entries: Tensor) -> Tensor:
        """The matrix, (..., 3 n, 3 n), with these entries below its diagonal, row by row."""
        rows = entries.new_zeros(*entries.shape[:-1], self.size * self.size)
        rows = rows.index_copy(-1, self.below, entries)
        return rows.reshape(*entries.shape[:-1], self.size, self.size)

    @staticmethod
    def _unit_solved(factor: Tensor, right: Tensor, upper: bool = False) -> Tensor:
        solution: Tensor = torch.linalg.solve_triangular(factor, right, upper=upper, unitriangular=True)
        return solution

    def forward(self, encoded: Tensor, prepared: Layers) -> tuple[Tensor, DenseIntermediates]:
        """M(q), and what its derivatives need."""
        raw, intermediates = self.network.forward(encoded, prepared)
        factor, scale = self._factor(raw)
        moved = self._unit_solved(factor, self.moving)
        mass = moved.mT @ (moved / scale.unsqueeze(-1))
        return mass, DenseIntermediates(intermediates, factor, moved, scale)

    def kinetic_vjp(self, qd: Tensor, intermediates: DenseIntermediates) -> Tensor:
        """The derivative of 1/2 qd^T M(q) qd by the encoding."""
        _, factor, moved, scale = intermediates
        speed = moved @ qd.unsqueeze(-1)
        momentum = speed / scale.unsqueeze(-1)
        by_factor = -self._unit_solved(factor.mT, momentum, upper=True) @ speed.mT
        by_entry = by_factor.flatten(-2).index_select(-1, self.below)
        by_scale = 0.5 * momentum.squeeze(-1) ** 2 * torch.expm1(-scale)
        cotangent = torch.cat([by_entry, by_scale], dim=-1)
        return self.network.vjp(intermediates.network, cotangent)

    def jvp(self, rate: Tensor, intermediates: DenseIntermediates) -> Tensor:
        """dM/dt, (..., n, n), where the encoding changes at this rate."""
        _, factor, moved, scale = intermediates
        pushed = self.network.jvp(intermediates.network, rate)
        entries, raw_rate = pushed.tensor_split((len(self.below),), dim=-1)
        turned = self._unit_solved(factor, self._lower(entries) @ moved)
        by_factor = moved.mT @ (turned / scale.unsqueeze(-1))
        by_scale = raw_rate * torch.expm1(-scale) / scale**2
        return moved.mT @ (moved * by_scale.unsqueeze(-1)) - by_factor - by_factor.mT
