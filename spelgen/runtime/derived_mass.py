"""M(q) by the fewest functions and constants: M = sum_j f_j(q) B_j + sum_k c_k A_k + armature."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.armature import Armature
from spelgen.runtime.joints import Joints, Pairs, vector
from spelgen.runtime.parts import Layers, Network, NetworkResiduals
from spelgen.runtime.regularisation import PositiveDefiniteBound
from spelgen.runtime.symmetric import Entries


class DerivedMass(nn.Module):
    """M(q), (..., n, n): ``entries`` of functions f and constants c, and the armature.

    A function is its first number + the second times a network's output; a constant starts at its first
    and is trained in units of the second. Where M would not exceed margin times its nominal mean, it is drawn
    towards that mean (see PositiveDefiniteBound): M is positive definite for all q and weights.
    """

    kinds = (("raw_constants", "mass_constants", "kg m^2, kg m, kg"),)

    def __init__(
        self,
        joints: Joints,
        entries: Entries,
        functions: Pairs,
        constants: Pairs,
        network: Network,
        margin: float,
    ) -> None:
        super().__init__()
        self.entries, self.network, self.rotors = entries, network, Armature(joints)
        self.constant_scale = nn.Buffer(vector(unit for _, unit in constants))
        self.function_mean = nn.Buffer(vector(mean for mean, _ in functions))
        self.function_scale = nn.Buffer(vector(scale for _, scale in functions))
        self.raw_constants = nn.Parameter(vector(start / unit for start, unit in constants))
        self.bound = PositiveDefiniteBound(self._by_outputs()[-1].detach(), margin)

    def constants(self) -> Tensor:
        """Return the constants of M, (constants,), in their units."""
        return self.constant_scale * self.raw_constants

    def _by_outputs(self) -> Tensor:
        """Return what each of the network's outputs adds to M, then M without any, (outputs + 1, n, n)."""
        functions = torch.cat([torch.diag(self.function_scale), self.function_mean.unsqueeze(-1)], dim=1)
        constants = F.pad(self.constants().unsqueeze(-1), (len(functions), 0))
        return self.entries(functions.unbind(), constants.unbind())

    def prepare(self, definite: bool = True) -> tuple[Layers, bool]:
        """Return the network's layers, which give M's entries; ``definite``: keep M positive definite."""
        rows = self._by_outputs()
        offset = rows[-1] + torch.diag(self.rotors.forward())
        return self.network.prepare(rows[:-1].flatten(1).mT, offset.flatten()), definite

    def _square(self, rows: Tensor) -> Tensor:
        """(..., n n) as (..., n, n)."""
        return rows.reshape(*rows.shape[:-1], *self.bound.center.shape)

    def forward(
        self, encoded: Tensor, prepared: tuple[Layers, bool]
    ) -> tuple[Tensor, tuple[NetworkResiduals, Tensor]]:
        """Return M(q), what the network's derivatives need, and how much of its changes M takes."""
        layers, definite = prepared
        rows, residuals = self.network.forward(encoded, layers)
        mass = self._square(rows)
        mass, fraction = self.bound.forward(mass) if definite else (mass, torch.ones_like(mass[..., 0, 0]))
        return mass, (residuals, fraction)

    def kinetic_vjp(self, encoded: Tensor, qd: Tensor, residuals: tuple[NetworkResiduals, Tensor]) -> Tensor:
        """Return the derivative of 1/2 qd^T M(q) qd by the encoding."""
        network, fraction = residuals
        half = 0.5 * fraction.unsqueeze(-1) * qd
        by_encoded: Tensor = self.network.vjp(network, (half.unsqueeze(-1) * qd.unsqueeze(-2)).flatten(-2))
        return by_encoded

    def jvp(self, rate: Tensor, residuals: tuple[NetworkResiduals, Tensor]) -> Tensor:
        """Return dM/dt, (..., n, n), where the encoding changes at this rate."""
        network, fraction = residuals
        moved: Tensor = fraction[..., None, None] * self._square(self.network.jvp(network, rate))
        return moved
