"""M(q) by the fewest functions and constants: M = sum_j f_j(q) B_j + sum_k c_k A_k + armature."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.joints import Joints, Pairs, vector
from spelgen.runtime.parts import Intermediates, Layers, Network
from spelgen.runtime.regularisation import PositiveDefiniteBound
from spelgen.runtime.symmetric import Entries


class DerivedMass(nn.Module):
    """M(q), (..., n, n): ``entries`` of functions f and constants c, and the armature.

    A function is its first number + the second times a network's output; a constant starts at its first
    and is trained in units of the second. Where M would not exceed margin times its nominal mean, it is drawn
    towards that mean (see PositiveDefiniteBound): M is positive definite for all q and weights.
    """

    kinds = (
        ("raw_constants", "mass_constants", "kg m^2, kg m, kg"),
        ("raw_armature", "armature", "kg m^2, kg"),
    )

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
        self.entries, self.network = entries, network
        self.constant_scale = nn.Buffer(vector(unit for _, unit in constants))
        self.function_mean = nn.Buffer(vector(mean for mean, _ in functions))
        self.function_scale = nn.Buffer(vector(scale for _, scale in functions))
        self.raw_constants = nn.Parameter(vector(start / unit for start, unit in constants))
        self.nominal_armature = nn.Buffer(vector(joints.armature))
        self.raw_armature = nn.Parameter(torch.zeros_like(self.nominal_armature))  # its logarithm
        self.bound = PositiveDefiniteBound(self._by_outputs()[-1].detach(), margin)

    def armature(self) -> Tensor:
        """Return the drives' part of M's diagonal, (n,) [kg m^2, kg]."""
        return self.nominal_armature * self.raw_armature.exp()

    def constants(self) -> Tensor:
        """Return the constants of M, (constants,), in their units."""
        return self.constant_scale * self.raw_constants

    def _by_outputs(self) -> Tensor:
        """Return what each of the network's outputs adds to M, then M without any, (outputs + 1, n, n)."""
        functions = torch.cat([torch.diag(self.function_scale), self.function_mean.unsqueeze(-1)], dim=1)
        constants = F.pad(self.constants().unsqueeze(-1), (len(functions), 0))
        return self.entries(functions.unbind(), constants.unbind())

    def prepare(self) -> Layers:
        """Return the network's layers, which give M's entries."""
        rows = self._by_outputs()
        offset = rows[-1] + torch.diag(self.armature())
        return self.network.prepare(rows[:-1].flatten(1).mT, offset.flatten())

    def forward(self, encoded: Tensor, layers: Layers) -> tuple[Tensor, tuple[Intermediates, Tensor]]:
        """Return M(q), what the network's derivatives need, and how much of its changes M takes."""
        rows, intermediates = self.network.forward(encoded, layers)
        mass, fraction = self.bound.forward(rows.reshape(*rows.shape[:-1], *self.bound.center.shape))
        return mass, (intermediates, fraction)

    def kinetic_vjp(self, qd: Tensor, intermediates: tuple[Intermediates, Tensor]) -> Tensor:
        """Return the derivative of 1/2 qd^T M(q) qd by the encoding."""
        network, fraction = intermediates
        half = 0.5 * fraction.unsqueeze(-1) * qd
        return self.network.vjp(network, (half.unsqueeze(-1) * qd.unsqueeze(-2)).flatten(-2))

    def jvp(self, rate: Tensor, intermediates: tuple[Intermediates, Tensor]) -> Tensor:
        """Return dM/dt, (..., n, n), where the encoding changes at this rate."""
        network, fraction = intermediates
        rows = fraction.unsqueeze(-1) * self.network.jvp(network, rate)
        return rows.reshape(*rows.shape[:-1], *self.bound.center.shape)
