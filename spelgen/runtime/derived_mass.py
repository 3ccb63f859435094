"""M(q) by the fewest functions and constants: M = sum_j f_j(q) B_j + sum_k c_k A_k + armature."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.armature import Armature
from spelgen.runtime.joints import Joints, vector
from spelgen.runtime.parts import Network
from spelgen.runtime.regularisation import PositiveDefiniteBound
from spelgen.runtime.symmetric import Entries


class MassPrepared(NamedTuple):
    """What depends on the weights alone."""

    layers: Any  # of the network
    definite: bool  # whether M is kept positive definite


class MassResiduals(NamedTuple):
    """What M's derivatives need of the work done for M."""

    network: Any
    fraction: Tensor  # of the functions' changes that M takes, see PositiveDefiniteBound


class DerivedMass(nn.Module):
    """M(q), (..., n, n): ``entries`` of functions f and constants c, and the armature.

    f = mean + scale y, with y a network's outputs. A constant starts at the first of its two numbers
    and is trained in units of the second. Where M would not exceed margin times its nominal mean, it is
    drawn towards that mean (see PositiveDefiniteBound): M is positive definite for all q and weights.
    """

    kinds = (("raw_constants", "mass_constants", "kg m^2, kg m, kg"),)

    constant_scale: Tensor
    function_mean: Tensor
    function_scale: Tensor

    def __init__(
        self,
        joints: Joints,
        entries: Entries,
        mean: Sequence[float],
        scale: Sequence[float],
        constants: Sequence[tuple[float, float]],
        network: Network,
        margin: float,
    ) -> None:
        super().__init__()
        self.n, self.entries, self.network = joints.n, entries, network
        self.register_buffer("constant_scale", vector(unit for _, unit in constants))
        self.register_buffer("function_mean", vector(mean))
        self.register_buffer("function_scale", vector(scale))
        self.raw_constants = nn.Parameter(vector(start / unit for start, unit in constants))
        self.rotors = Armature(joints)
        self.bound = PositiveDefiniteBound(self._by_outputs()[-1].detach(), margin)

    def constants(self) -> Tensor:
        """Return the constants of M, (constants,), in their units."""
        return self.constant_scale * self.raw_constants

    def _by_outputs(self) -> Tensor:
        """Return what each of the network's outputs adds to M, then M without any, (outputs + 1, n, n)."""
        functions = torch.cat([torch.diag(self.function_scale), self.function_mean.unsqueeze(-1)], dim=1)
        constants = F.pad(self.constants().unsqueeze(-1), (len(functions), 0))
        return self.entries(functions.unbind(), constants.unbind())

    def prepare(self, definite: bool = True) -> MassPrepared:
        """Return all that depends on the weights alone; ``definite``: keep M positive definite."""
        rows = self._by_outputs()
        offset = rows[-1] + torch.diag(self.rotors.forward())
        output_map = rows[:-1].flatten(1).mT
        return MassPrepared(self.network.prepare(output_map, offset.flatten()), definite)

    def _square(self, rows: Tensor) -> Tensor:
        """(..., n n) as (..., n, n)."""
        return rows.reshape(*rows.shape[:-1], self.n, self.n)

    def forward(self, encoded: Tensor, prepared: MassPrepared) -> tuple[Tensor, MassResiduals]:
        """M(q), and what its derivatives need."""
        rows, residuals = self.network.forward(encoded, prepared.layers)
        mass = self._square(rows)
        fraction = torch.ones_like(mass[..., 0, 0])
        if prepared.definite:
            mass, fraction = self.bound.forward(mass)
        return mass, MassResiduals(residuals, fraction)

    def kinetic_vjp(self, encoded: Tensor, qd: Tensor, residuals: MassResiduals) -> Tensor:
        """The derivative of 1/2 qd^T M(q) qd by the encoding."""
        half = 0.5 * residuals.fraction.unsqueeze(-1) * qd
        weight = (half.unsqueeze(-1) * qd.unsqueeze(-2)).flatten(-2)
        return self.network.vjp(residuals.network, weight)

    def jvp(self, rate: Tensor, residuals: MassResiduals) -> Tensor:
        """dM/dt, (..., n, n), where the encoding changes at this rate."""
        rows = self.network.jvp(residuals.network, rate)
        return residuals.fraction[..., None, None] * self._square(rows)
