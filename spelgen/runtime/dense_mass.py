"""M^-1(q) over all three axes of every joint, without any structure of the arm."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.parts import Intermediates, Layers, Network, Rows
from spelgen.runtime.rows import Joint, vector


class DenseIntermediates(NamedTuple):
    """Values of the computation of M that its derivatives need."""

    network: Intermediates
    factor: Tensor  # U
    moved: Tensor  # U^-1 A, with A the moving columns of C^-1
    scale: Tensor  # e


def nominal_factor(joints: Sequence[Joint], mean: Rows) -> Tensor:
    """Return C, (3 n, 3 n), lower triangular: C C^T is the nominal mean of M^-1 over all axes.

    ``mean`` is the lower triangle of the nominal mean of M without armature. A joint moves along z; its
    inertia about the other axes is assumed to be equal.
    """
    n = len(joints)
    mass = torch.zeros(n, n, dtype=torch.float64)
    row, column = torch.tril_indices(n, n)
    mass[row, column] = mass[column, row] = vector(x for entries in mean for x in entries)
    mass += torch.diag(vector(joint.armature for joint in joints))
    everywhere = torch.diag(mass.diagonal().repeat_interleave(3))
    everywhere[2::3, 2::3] = mass
    factor: Tensor = torch.linalg.cholesky(torch.linalg.inv(everywhere))
    return factor


class DenseMass(nn.Module):
    """M(q), (..., n, n), from M^-1 = C U diag(e) U^T C^T over all axes, (3 n, 3 n).

    C is the Cholesky factor of the nominal mean, U lower triangular with ones on its diagonal and
    e > 0, both outputs of a network: the Cholesky factorisation without square roots. Joints do not move
    along their axes x and y, so M is the moving block of the inverse:
    (U^-1 A)^T diag(1 / e) U^-1 A, where A is the moving columns of C^-1.
    """

    def __init__(self, joints: Sequence[Joint], *, mean: Rows, network: Network) -> None:
        super().__init__()
        self.size = 3 * len(joints)
        factor = nominal_factor(joints, mean)
        self.nominal = nn.Buffer(factor)
        self.moving = nn.Buffer(torch.linalg.inv(factor)[:, 2::3])
        row, column = torch.tril_indices(self.size, self.size, -1)
        # positions in U of the entries below its diagonal, rows in sequence
        self.below = nn.Buffer(row * self.size + column)
        # initially U is the identity, and e is one
        initial = vector([0.0] * len(row) + [math.log(math.e - 1)] * self.size)
        self.initial = nn.Buffer(initial)
        self.network = network

    def prepare(self) -> Layers:
        """Return the layers of the network."""
        return self.network.prepare(torch.diag(0 * self.initial + 1), self.initial)

    def inverse(self, encoded: Tensor, layers: Layers) -> Tensor:
        """Return M^-1 over all three axes of every joint, of which z moves; (..., 3 n, 3 n)."""
        factor, scale = self._factor(self.network.forward(encoded, layers)[0])
        lower = self.nominal @ (factor + torch.eye(self.size).to(factor))
        return (lower * scale.unsqueeze(-2)) @ lower.mT

    def _factor(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        """Return U without its diagonal of ones, (..., 3 n, 3 n), and e, (..., 3 n)."""
        entries, scale = raw.tensor_split((len(self.below),), dim=-1)
        return self._lower(entries), F.softplus(scale)

    def _lower(self, entries: Tensor) -> Tensor:
        """Return the matrix, (..., 3 n, 3 n), with these entries below its diagonal, rows in sequence."""
        rows = entries.new_zeros(*entries.shape[:-1], self.size * self.size)
        rows = rows.index_copy(-1, self.below, entries)
        return rows.reshape(*entries.shape[:-1], self.size, self.size)

    @staticmethod
    def _unit_solved(factor: Tensor, right: Tensor, upper: bool = False) -> Tensor:
        solution: Tensor = torch.linalg.solve_triangular(factor, right, upper=upper, unitriangular=True)
        return solution

    def forward(self, encoded: Tensor, layers: Layers) -> tuple[Tensor, DenseIntermediates]:
        """Return M(q), (..., n, n), and the intermediates of its derivatives."""
        raw, intermediates = self.network.forward(encoded, layers)
        factor, scale = self._factor(raw)
        # Triangular solutions, not an inverse of M^-1, whose condition number is the square of its
        # factor's.
        moved = self._unit_solved(factor, self.moving)
        mass = moved.mT @ (moved / scale.unsqueeze(-1))
        return mass, DenseIntermediates(intermediates, factor, moved, scale)

    def kinetic_vjp(self, qd: Tensor, intermediates: DenseIntermediates) -> Tensor:
        """Return d(1/2 qd^T M(q) qd) / d encoding, (..., 2 n), at the velocity qd (..., n)."""
        _, factor, moved, scale = intermediates
        speed = moved @ qd.unsqueeze(-1)
        momentum = speed / scale.unsqueeze(-1)
        # With w = U^-1 A qd and p = w / e: dT/dU = -U^-T p w^T, and dT/de = -p^2 / 2.
        by_factor = -self._unit_solved(factor.mT, momentum, upper=True) @ speed.mT
        by_entry = by_factor.flatten(-2).index_select(-1, self.below)
        # e = softplus(s): de/ds = 1 - exp(-e) = -expm1(-e).
        by_scale = 0.5 * momentum.squeeze(-1) ** 2 * torch.expm1(-scale)
        cotangent = torch.cat([by_entry, by_scale], dim=-1)
        return self.network.vjp(intermediates.network, cotangent)

    def jvp(self, rate: Tensor, intermediates: DenseIntermediates) -> Tensor:
        """Return dM/dt, (..., n, n), for this rate of the encoding."""
        _, factor, moved, scale = intermediates
        pushed = self.network.jvp(intermediates.network, rate)
        entries, raw_rate = pushed.tensor_split((len(self.below),), dim=-1)
        # d(U^-1 A) = -U^-1 dU U^-1 A.
        turned = self._unit_solved(factor, self._lower(entries) @ moved)
        by_factor = moved.mT @ (turned / scale.unsqueeze(-1))
        by_scale = raw_rate * torch.expm1(-scale) / scale**2
        return moved.mT @ (moved * by_scale.unsqueeze(-1)) - by_factor - by_factor.mT
