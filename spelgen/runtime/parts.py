"""Interfaces of the mass matrix and the input matrix of a model, and the function ``symmetric``."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor

Row = Sequence[float]
Rows = Sequence[Sequence[float]]
Entries = Callable[..., Tensor]  # returns M, (..., n, n), from functions and constants, (...) each
Layers = tuple[tuple[Tensor, Tensor], ...]  # masked weights, and biases, of each layer of a network
# The following types are Any, because each class of models defines its own named tuples for them.
Intermediates = Any  # values of a forward pass that its derivatives need
Parameters = Any  # parameter cache: quantities that depend on trained parameters only
Configuration = Any  # configuration cache: quantities that depend on q, for given parameters
Position = Any  # q, (..., n), or the configuration cache at q


class Mass(Protocol):
    """Interface of a mass matrix M(q) with explicit derivatives."""

    def prepare(self) -> Parameters:
        """Return the parameter cache: quantities that depend on trained parameters only."""

    def forward(self, encoded: Tensor, parameters: Parameters) -> tuple[Tensor, Intermediates]:
        """Return M(q), (..., n, n), and intermediate values for the derivatives of M."""

    def kinetic_vjp(self, qd: Tensor, intermediates: Intermediates) -> Tensor:
        """Return d(1/2 qd^T M(q) qd) / d encoding, (..., 2 n), at the velocity qd (..., n)."""

    def jvp(self, rate: Tensor, intermediates: Intermediates) -> Tensor:
        """Return dM/dt, (..., n, n), for a time derivative of the encoding, (..., 2 n)."""


class Inputs(Protocol):
    """Interface of a constant input matrix G, for motors that drive several joints and for passive joints."""

    def gains(self) -> Tensor:
        """Return G, (n, n): joint torque per motor torque."""

    def force(self, tau: Tensor) -> Tensor:
        """Return G tau, (..., n) [Nm, N]."""

    def torque(self, force: Tensor) -> Tensor:
        """Return the inputs tau, (..., n), that solve G tau = force, with force (..., n) [Nm, N]."""


def symmetric(*rows: Sequence[Tensor | float]) -> Tensor:
    """Return a symmetric matrix, (..., n, n).

    rows: rows of its lower triangle; the entries are tensors, (...), or numbers.
    """
    n = len(rows)
    entries = [rows[max(i, j)][min(i, j)] for i in range(n) for j in range(n)]
    like = next(entry for entry in entries if isinstance(entry, Tensor))
    filled = [entry if isinstance(entry, Tensor) else torch.full_like(like, entry) for entry in entries]
    return torch.stack(filled, dim=-1).reshape(*like.shape, n, n)
