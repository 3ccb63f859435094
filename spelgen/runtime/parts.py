"""The interfaces between a model and its parts, and symmetric matrices from their lower triangle."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor

Row = Sequence[float]
Rows = Sequence[Sequence[float]]
Entries = Callable[..., Tensor]  # a symmetric matrix (..., n, n) of its functions and constants (...)
Layers = tuple[tuple[Tensor, Tensor], ...]  # weights and biases of a network, masked and scaled
# The types of these differ between models and parts.
Intermediates = Any  # values of the forward pass that the derivatives of a part need
Parameters = Any  # parameter cache: all that depends on the parameters only
Configuration = Any  # configuration cache: all that depends on q only
Position = Any  # q, (..., n), or the configuration at q


class Mass(Protocol):
    """The mass matrix M(q) and its derivatives."""

    def prepare(self) -> Parameters:
        """Return the parameter cache: all that depends on the parameters only."""

    def forward(self, encoded: Tensor, parameters: Parameters) -> tuple[Tensor, Intermediates]:
        """Return M(q), (..., n, n), and the intermediates of its derivatives."""

    def kinetic_vjp(self, qd: Tensor, intermediates: Intermediates) -> Tensor:
        """Return d(1/2 qd^T M(q) qd) / d encoding, (..., 2 n), at the velocity qd (..., n)."""

    def jvp(self, rate: Tensor, intermediates: Intermediates) -> Tensor:
        """Return dM/dt, (..., n, n), for this rate of the encoding."""


class Inputs(Protocol):
    """The input matrix G of motors that drive several joints, or none."""

    def gains(self) -> Tensor:
        """Return G, (n, n): joint torque per motor torque."""

    def force(self, tau: Tensor) -> Tensor:
        """Return G tau, (..., n) [Nm, N]."""

    def torque(self, force: Tensor) -> Tensor:
        """Return the inputs, (..., n), that give this force."""


def symmetric(*rows: Sequence[Tensor | float]) -> Tensor:
    """Return the symmetric matrix, (..., n, n), from its lower triangle: rows of tensors (...) or numbers."""
    n = len(rows)
    entries = [rows[max(i, j)][min(i, j)] for i in range(n) for j in range(n)]
    like = next(entry for entry in entries if isinstance(entry, Tensor))
    filled = [entry if isinstance(entry, Tensor) else torch.full_like(like, entry) for entry in entries]
    return torch.stack(filled, dim=-1).reshape(*like.shape, n, n)
