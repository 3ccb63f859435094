"""Interface of the mass matrix M(q) of a model, and shared types and functions of the runtime."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor

Row = Sequence[float]
Rows = Sequence[Sequence[float]]
Entries = Callable[..., Tensor]  # (functions of q and constants, (...) each) -> M, (..., n, n)
Layers = tuple[tuple[Tensor, Tensor], ...]  # (masked weights, biases) of each layer of a network
# The four types below are Any, because each class of models defines its own named tuples for them.
Intermediates = Any  # intermediate values of a network's evaluation, for its derivatives
Parameters = Any  # parameter cache: quantities that depend on trained parameters only
Configuration = Any  # configuration cache: quantities that depend on q, for given parameters
Position = Any  # joint positions q, (..., n), or the configuration cache at q


class Mass(Protocol):
    """Interface of a mass matrix M(q), (..., n, n), with explicit derivatives.

    M and its derivatives are functions of the encoding of q, (..., 2 n), see ``JointEncoding``.
    """

    def prepare(self) -> Parameters:
        """Return the parameter cache: quantities that depend on trained parameters only."""

    def forward(self, encoded: Tensor, parameters: Parameters) -> tuple[Tensor, Intermediates]:
        """Return M(q), (..., n, n), and intermediate values for ``kinetic_vjp`` and ``jvp``.

        encoded: encoding of q, (..., 2 n). parameters: from ``prepare``.
        """

    def kinetic_vjp(self, qd: Tensor, intermediates: Intermediates) -> Tensor:
        """Return the gradient of 1/2 qd^T M(q) qd with respect to the encoding of q, (..., 2 n).

        The encoding is cos q and sin q of revolute joints (``JointEncoding``). qd: velocities, (..., n).
        intermediates: second result of ``forward`` at q.
        """

    def jvp(self, rate: Tensor, intermediates: Intermediates) -> Tensor:
        """Return dM/dt, (..., n, n), for ``rate``, the time derivative of the encoding of q, (..., 2 n).

        intermediates: second result of ``forward`` at q.
        """


def applied(matrix: Tensor, vector: Tensor) -> Tensor:
    """Return the product of a matrix, (..., n, m), and a vector, (..., m)."""
    # A single vector needs no reshapes, which a batch of vectors needs before and after the product.
    if vector.dim() == 1:
        return matrix @ vector
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


def symmetric(*rows: Sequence[Tensor | float]) -> Tensor:
    """Return the symmetric matrix, (..., n, n), with the given lower triangle.

    rows: rows of the lower triangle; at least one entry is a tensor, (...), the others may be numbers.
    """
    n = len(rows)
    entries = [rows[max(i, j)][min(i, j)] for i in range(n) for j in range(n)]
    like = next(entry for entry in entries if isinstance(entry, Tensor))
    filled = [entry if isinstance(entry, Tensor) else torch.full_like(like, entry) for entry in entries]
    return torch.stack(filled, dim=-1).reshape(*like.shape, n, n)
