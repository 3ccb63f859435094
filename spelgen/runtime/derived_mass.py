"""M(q) by the fewest functions and constants: M = sum_j f_j(q) B_j + sum_k c_k A_k + armature."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from spelgen.runtime.armature import Armature
from spelgen.runtime.joints import Joints, vector
from spelgen.runtime.network import Network
from spelgen.runtime.regularisation import PositiveDefiniteBound
from spelgen.runtime.symmetric import Entries, entry_basis


class MassFunction(NamedTuple):
    """A learned function f of some joints: mean + scale * network."""

    joints: tuple[int, ...]
    mean: float  # over the workspace, with nominal inertias
    scale: float


class MassPrepared(NamedTuple):
    """What depends on the weights alone."""

    layers: Any  # of the network
    definite: bool  # whether M is kept positive definite


class MassResiduals(NamedTuple):
    """What M's derivatives need of the work done for M."""

    network: Any
    part: Tensor  # of the functions' changes that M takes, see PositiveDefiniteBound


class DerivedMass(nn.Module):
    """M(q), (..., n, n), with ``entries`` saying where functions and constants stand.

    A constant starts at the first of its two numbers, and is trained in units of the second. Where
    M would not exceed margin * its nominal mean, it is drawn towards that mean (see
    PositiveDefiniteBound): M is positive definite for all q and all weights.
    """

    kinds = (("raw_constants", "mass_constants", "kg m^2, kg m, kg"),)

    constant_scale: Tensor
    constant_basis: Tensor  # (constants, n n)
    function_mean: Tensor
    function_scale: Tensor
    function_basis: Tensor  # (functions, n n)

    def __init__(
        self,
        joints: Joints,
        entries: Entries,
        functions: Sequence[MassFunction],
        constants: Sequence[tuple[float, float]],
        network: Network,
        margin: float,
    ) -> None:
        super().__init__()
        self.n = joints.n
        start = vector(first for first, _ in constants)
        by_function, by_constant = entry_basis(entries, len(functions), len(constants))
        self.register_buffer("constant_scale", vector(unit for _, unit in constants))
        self.register_buffer("constant_basis", by_constant)
        self.register_buffer("function_mean", vector(each.mean for each in functions))
        self.register_buffer("function_scale", vector(each.scale for each in functions))
        self.register_buffer("function_basis", by_function)
        mean = start @ self.constant_basis + self.function_mean @ self.function_basis
        self.bound = PositiveDefiniteBound(self._square(mean), margin)
        self.raw_constants = nn.Parameter(start / self.constant_scale)
        self.network = network
        self.rotors = Armature(joints)

    def constants(self) -> Tensor:
        """The constants of M, (constants,), in their units."""
        return self.constant_scale * self.raw_constants

    def prepare(self, definite: bool = True) -> MassPrepared:
        """All that depends on the weights alone; ``definite``: keep M positive definite."""
        armature = torch.diag(self.rotors())
        constant = self.constants() @ self.constant_basis
        constant = constant + self.function_mean @ self.function_basis + armature.flatten()
        output_map = (self.function_scale.unsqueeze(-1) * self.function_basis).mT
        return MassPrepared(self.network.prepare(output_map, constant), definite)

    def _square(self, rows: Tensor) -> Tensor:
        """(..., n n) as (..., n, n)."""
        return rows.reshape(*rows.shape[:-1], self.n, self.n)

    def forward(self, encoded: Tensor, prepared: MassPrepared) -> tuple[Tensor, MassResiduals]:
        """M(q), and what its derivatives need."""
        rows, residuals = self.network(encoded, prepared.layers)
        mass = self._square(rows)
        part = torch.ones_like(mass[..., 0, 0])
        if prepared.definite:
            mass, part = self.bound(mass)
        return mass, MassResiduals(residuals, part)

    def kinetic_vjp(self, encoded: Tensor, qd: Tensor, residuals: MassResiduals) -> Tensor:
        """The derivative of 1/2 qd^T M(q) qd by the encoding."""
        half = 0.5 * residuals.part.unsqueeze(-1) * qd
        weight = (half.unsqueeze(-1) * qd.unsqueeze(-2)).flatten(-2)
        return self.network.vjp(residuals.network, weight)

    def jvp(self, rate: Tensor, residuals: MassResiduals) -> Tensor:
        """dM/dt, (..., n, n), where the encoding changes at this rate."""
        rows = self.network.jvp(residuals.network, rate)
        return residuals.part[..., None, None] * self._square(rows)
