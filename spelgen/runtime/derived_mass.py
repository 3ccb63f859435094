"""M(q) from the fewest functions and constants: M = sum_j f_j(q) B_j + sum_k c_k A_k + armature; or from constants."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.networks import MaskedNetwork
from spelgen.runtime.parts import Entries, Intermediates, Layers
from spelgen.runtime.rows import Constant, Function, Joint, vector


class LinearMass(nn.Module):
    """The constants and the armature of an M that is linear in functions of q and constants."""

    parameter_groups = (
        ("raw_constants", "mass_constants", "kg m^2, kg m, kg"),
        ("raw_armature", "armature", "kg m^2, kg"),
    )

    def __init__(
        self,
        joints: Sequence[Joint],
        entries: Entries,
        *,
        constants: Sequence[Constant],
        functions: Sequence[Function] | None = None,
    ) -> None:
        super().__init__()
        self.entries = entries
        self.constant_scale = nn.Buffer(vector(x.scale for x in constants))
        if functions is not None:
            self.function_mean = nn.Buffer(vector(f.mean for f in functions))
            self.function_scale = nn.Buffer(vector(f.scale for f in functions))
        self.raw_constants = nn.Parameter(vector(x.initial / x.scale for x in constants))
        self.nominal_armature = nn.Buffer(vector(joint.armature for joint in joints))
        self.raw_armature = nn.Parameter(torch.zeros_like(self.nominal_armature))  # logarithm

    def armature(self) -> Tensor:
        """Return the rotor inertia on the joint side, part of the diagonal of M, (n,) [kg m^2, kg]."""
        return self.nominal_armature * self.raw_armature.exp()

    def constants(self) -> Tensor:
        """Return the constants of M, (constants,) [kg m^2, kg m, kg]."""
        return self.constant_scale * self.raw_constants


class ConstantMass(LinearMass):
    """M, (..., n, n), that does not depend on q: ``entries(*constants)`` and the armature.

    The absolute values of the constants are used, so that M stays positive definite.
    """

    def constants(self) -> Tensor:
        """Return the constants of M, (constants,) [kg m^2, kg m, kg]."""
        return self.constant_scale * (self.raw_constants.abs() + 1e-6)

    def prepare(self) -> Tensor:
        """Return M, (n, n)."""
        return self.entries(*self.constants().unbind()) + torch.diag(self.armature())

    def forward(self, encoded: Tensor, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Return M, (..., n, n), and the encoding, (..., 2 n), which has the shape of its derivatives."""
        return parameters.expand(*encoded.shape[:-1], *parameters.shape), encoded

    def kinetic_vjp(self, qd: Tensor, intermediates: Tensor) -> Tensor:
        """Return d(1/2 qd^T M qd) / d encoding, (..., 2 n): zero."""
        return torch.zeros_like(intermediates)

    def jvp(self, rate: Tensor, intermediates: Tensor) -> Tensor:
        """Return dM/dt, (..., n, n): zero."""
        n = len(self.raw_armature)
        return rate.new_zeros(*rate.shape[:-1], n, n)


class DerivedMass(LinearMass):
    """M(q), (..., n, n): ``entries(*functions, *constants)`` and the armature.

    M is positive definite for all q and all parameters: if M - margin C is not, with C the nominal mean of
    M, it is replaced by M' = C + t (M - C). t = 2^-k is the first such power with t |M - C| <= 1 - margin,
    where |.| is an upper bound of the norm relative to C. t is piecewise constant, so that the derivatives
    of M' are t times the derivatives of M. C has the zeros and linear relations of M, which therefore
    hold in M'.
    """

    def __init__(
        self,
        joints: Sequence[Joint],
        entries: Entries,
        *,
        functions: Sequence[Function],
        constants: Sequence[Constant],
        network: MaskedNetwork,
        margin: float,
    ) -> None:
        super().__init__(joints, entries, constants=constants, functions=functions)
        self.network = network
        center = self._by_outputs()[-1].detach()
        self.center, self.smallest = nn.Buffer(center), nn.Buffer(margin * center)  # C and margin C
        size = center.diagonal().rsqrt()
        relative = size.unsqueeze(-1) * size
        eigenvalue = torch.linalg.eigvalsh(relative * center)[0]
        # bound of the norm relative to C per entry of M - C, divided by 1 - margin
        self.unit = nn.Buffer(relative / eigenvalue / (1 - margin))

    def _by_outputs(self) -> Tensor:
        """Return dM / d output per output of the network, then M at zero outputs, (outputs + 1, n, n)."""
        # M is linear in the outputs: unit outputs, and then the means with the constants, give all
        # coefficients.
        functions = torch.cat([torch.diag(self.function_scale), self.function_mean.unsqueeze(-1)], dim=1)
        constants = F.pad(self.constants().unsqueeze(-1), (len(functions), 0))
        return self.entries(*functions.unbind(), *constants.unbind())

    def prepare(self) -> Layers:
        """Return the layers that give the entries of M."""
        rows = self._by_outputs()
        # This linear map is composed with the last layer, so that the network returns the entries of M.
        offset = rows[-1] + torch.diag(self.armature())
        return self.network.prepare(rows[:-1].flatten(1).mT, offset.flatten())

    def forward(self, encoded: Tensor, layers: Layers) -> tuple[Tensor, tuple[Intermediates, Tensor]]:
        """Return M'(q), (..., n, n), and the intermediates of its derivatives: of the network, and t."""
        rows, intermediates = self.network.forward(encoded, layers)
        mass = rows.reshape(*rows.shape[:-1], *self.center.shape)
        fraction = self.fraction(mass.detach())
        return torch.lerp(self.center, mass, fraction[..., None, None]), (intermediates, fraction)

    def fraction(self, mass: Tensor) -> Tensor:
        """Return t, (...), of matrices M, (..., n, n)."""
        # cholesky_ex reports a failure per matrix of the batch; cholesky would raise an error for all of
        # them.
        indefinite = torch.linalg.cholesky_ex(mass - self.smallest).info != 0
        # The Frobenius norm of the scaled difference: an upper bound of its spectral norm.
        norm = torch.linalg.vector_norm(self.unit * (mass - self.center), dim=(-2, -1))
        return torch.where(indefinite, torch.exp2(-torch.ceil(torch.log2(norm)).clamp(min=1.0)), 1.0)

    def kinetic_vjp(self, qd: Tensor, intermediates: tuple[Intermediates, Tensor]) -> Tensor:
        """Return d(1/2 qd^T M(q) qd) / d encoding, (..., 2 n), at the velocity qd (..., n)."""
        network, fraction = intermediates
        # d(1/2 qd^T M' qd) / dM' = 1/2 qd qd^T, and M' has t times the derivative of M.
        half = 0.5 * fraction.unsqueeze(-1) * qd
        return self.network.vjp(network, (half.unsqueeze(-1) * qd.unsqueeze(-2)).flatten(-2))

    def jvp(self, rate: Tensor, intermediates: tuple[Intermediates, Tensor]) -> Tensor:
        """Return dM/dt, (..., n, n), for this rate of the encoding."""
        network, fraction = intermediates
        rows = fraction.unsqueeze(-1) * self.network.jvp(network, rate)
        return rows.reshape(*rows.shape[:-1], *self.center.shape)
