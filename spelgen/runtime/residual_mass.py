"""What M(q) has beside rigid bodies, by the fewest functions and constants."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.joints import Joints, blocks
from spelgen.runtime.parts import Network, NetworkResiduals
from spelgen.runtime.port_hamiltonian import applied, combined
from spelgen.runtime.symmetric import Entries

PART = 0.9  # of the drives' inertia, which the residual may take away at most
NEVER = 1e30  # how large a function may be by an entry where it does not stand


class ResidualMassPrepared(NamedTuple):
    """What depends on the weights alone."""

    layers: Any  # of the network
    functions: Tensor  # what each function adds to M at its largest, (functions, n n)
    constant: Tensor  # what the constants add, (n n,)


class FunctionResiduals(NamedTuple):
    """What the derivatives of R's functions need."""

    network: NetworkResiduals
    slope: Tensor  # of the functions by the network's outputs
    functions: Tensor  # what each adds to M at its largest


class ResidualMass(nn.Module):
    """R(q), (..., n, n), with ``entries`` saying where functions and constants stand.

    Each is its bound times the tanh of a network's output, or of a weight: the bounds are such that
    ``armature`` + R is positive definite for all q and all weights (see ``bounds``).
    """

    kinds = (("raw_constants", "mass_residuals", "kg m^2, kg m, kg"),)

    def __init__(
        self, joints: Joints, entries: Entries, functions: int, constants: int, network: Network | None
    ) -> None:
        super().__init__()
        self.n, self.functions, self.entries, self.network = joints.n, functions, entries, network
        size = self._scaled(torch.ones(functions + constants, dtype=torch.float64)).abs()
        # one by the size of each function and constant in an entry, NEVER where it has none
        self.inverse = nn.Buffer(torch.where(size > 0, 1 / size, NEVER))
        self.part = PART / float((size > 0).sum(dim=(0, 2)).max())  # of all that meet in a row of M
        self.raw_constants = nn.Parameter(torch.zeros(constants, dtype=torch.float64))

    def bounds(self, armature: Tensor) -> Tensor:
        """How large each function and constant may be, beside an armature matrix, (n, n).

        armature - diag(d) is positive semi-definite for d = 1 / (row sums of |armature^-1|), and so is
        diag(d) - R where no row of |R| / sqrt(d d^T) adds up to more than one: by diagonal dominance both.
        """
        root = torch.linalg.inv(armature).abs().sum(dim=-1).rsqrt()
        pairs = root.unsqueeze(-1) * root
        smallest: Tensor = (pairs * self.inverse).amin(dim=(-2, -1))
        return self.part * smallest

    def _scaled(self, sizes: Tensor) -> Tensor:
        """Return what functions and constants of these sizes add to M, (functions + constants, n, n)."""
        rows = torch.diag(sizes).unbind()
        return self.entries(rows[: self.functions], rows[self.functions :])

    def prepare(self, armature: Tensor) -> ResidualMassPrepared:
        """All that depends on the weights alone."""
        rows = self._scaled(self.bounds(armature)).flatten(1)
        functions, constants = rows.tensor_split((self.functions,))
        layers = None
        if self.network is not None:
            identity = torch.eye(self.functions, dtype=rows.dtype, device=rows.device)
            layers = self.network.prepare(identity, rows.new_zeros(self.functions))
        return ResidualMassPrepared(layers, functions, self.raw_constants.tanh() @ constants)

    def forward(
        self, encoded: Tensor, prepared: ResidualMassPrepared
    ) -> tuple[Tensor, FunctionResiduals | None]:
        """R(q), and what its derivatives need."""
        if self.network is None:
            return self._square(prepared.constant).expand(*encoded.shape[:-1], -1, -1), None
        y, residuals = self.network.forward(encoded, prepared.layers)
        height = y.tanh()
        rows = F.linear(height, prepared.functions.mT, prepared.constant)
        return self._square(rows), FunctionResiduals(residuals, 1 - height * height, prepared.functions)

    def _square(self, rows: Tensor) -> Tensor:
        """(..., n n) as (..., n, n)."""
        return rows.reshape(*rows.shape[:-1], self.n, self.n)

    def coriolis(
        self, rate: Tensor, qd: Tensor, residuals: FunctionResiduals | None
    ) -> tuple[Tensor, Tensor]:
        """dR/dt qd, (..., n), where the encoding changes at this rate, and what ``kinetic_vjp`` gives."""
        if self.network is None or residuals is None:
            return torch.zeros_like(qd), torch.zeros_like(rate)
        network, slope, functions = residuals
        moved = self._moved(qd, functions)
        by_encoded = self.network.vjp(network, 0.5 * slope * applied(moved, qd))
        return combined(slope * self.network.jvp(network, rate), moved), by_encoded

    def kinetic_vjp(self, encoded: Tensor, qd: Tensor, residuals: FunctionResiduals | None) -> Tensor:
        """The derivative of 1/2 qd^T R(q) qd by the encoding."""
        if self.network is None or residuals is None:
            return torch.zeros_like(encoded)
        network, slope, functions = residuals
        by_encoded: Tensor = self.network.vjp(network, 0.5 * slope * applied(self._moved(qd, functions), qd))
        return by_encoded

    def _moved(self, qd: Tensor, functions: Tensor) -> Tensor:
        """What each function adds to R qd at its largest, (..., functions, n)."""
        return blocks(F.linear(qd, functions.reshape(-1, self.n)), self.n)
