"""M(q) by the fewest functions and constants: M = sum_j f_j(q) B_j + sum_k c_k A_k + armature."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.joints import Joints, vector
from spelgen.runtime.parts import Intermediates, Layers, Layout, Network, Pairs


class DerivedMass(nn.Module):
    """M(q), (..., n, n): ``entries`` of functions f and constants c, and the armature.

    A function is its first number + the second times a network's output; a constant starts at its first
    and is trained in units of the second.

    M is positive definite for all q and weights: where M - margin C is not, with C the nominal mean of M,
    M' = C + t (M - C) takes its place. t = 2^-k is the first such power with t |M - C| <= 1 - margin, |.|
    being at least the norm relative to C. t is constant in pieces, so that derivatives of M' are t times
    those of M. C has M's own zeros and linear relations, which therefore hold in M'.
    """

    kinds = (
        ("raw_constants", "mass_constants", "kg m^2, kg m, kg"),
        ("raw_armature", "armature", "kg m^2, kg"),
    )

    def __init__(
        self, joints: Joints, entries: Layout, functions: Pairs, constants: Pairs, net: Network, margin: float
    ) -> None:
        super().__init__()
        self.entries, self.network = entries, net
        self.constant_scale = nn.Buffer(vector(unit for _, unit in constants))
        self.function_mean = nn.Buffer(vector(mean for mean, _ in functions))
        self.function_scale = nn.Buffer(vector(scale for _, scale in functions))
        self.raw_constants = nn.Parameter(vector(start / unit for start, unit in constants))
        self.nominal_armature = nn.Buffer(vector(joints.armature))
        self.raw_armature = nn.Parameter(torch.zeros_like(self.nominal_armature))  # its logarithm
        center = self._by_outputs()[-1].detach()
        self.center, self.smallest = nn.Buffer(center), nn.Buffer(margin * center)  # C and margin C
        size = center.diagonal().rsqrt()
        relative = size.unsqueeze(-1) * size
        eigenvalue = torch.linalg.eigvalsh(relative * center)[0]
        # an entry's largest part in the norm relative to C, divided by 1 - margin
        self.unit = nn.Buffer(relative / eigenvalue / (1 - margin))

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
        """Return M'(q), and, for its derivatives, what those of the network need and t."""
        rows, intermediates = self.network.forward(encoded, layers)
        mass = rows.reshape(*rows.shape[:-1], *self.center.shape)
        fraction = self.fraction(mass.detach())
        return torch.lerp(self.center, mass, fraction[..., None, None]), (intermediates, fraction)

    def fraction(self, mass: Tensor) -> Tensor:
        """Return t, (...)."""
        indefinite = torch.linalg.cholesky_ex(mass - self.smallest).info != 0
        norm = torch.linalg.vector_norm(self.unit * (mass - self.center), dim=(-2, -1))
        return torch.where(indefinite, torch.exp2(-torch.ceil(torch.log2(norm)).clamp(min=1.0)), 1.0)

    def kinetic_vjp(self, qd: Tensor, intermediates: tuple[Intermediates, Tensor]) -> Tensor:
        """Return the derivative of 1/2 qd^T M(q) qd by the encoding."""
        network, fraction = intermediates
        half = 0.5 * fraction.unsqueeze(-1) * qd
        return self.network.vjp(network, (half.unsqueeze(-1) * qd.unsqueeze(-2)).flatten(-2))

    def jvp(self, rate: Tensor, intermediates: tuple[Intermediates, Tensor]) -> Tensor:
        """Return dM/dt, (..., n, n), where the encoding changes at this rate."""
        network, fraction = intermediates
        rows = fraction.unsqueeze(-1) * self.network.jvp(network, rate)
        return rows.reshape(*rows.shape[:-1], *self.center.shape)
