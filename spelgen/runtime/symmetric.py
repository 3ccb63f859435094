"""Symmetric matrices written as their lower triangle."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

Entries = Callable[[Sequence[Tensor], Sequence[Tensor]], Tensor]


def symmetric(*rows: Sequence[Tensor | float]) -> Tensor:
    """The matrix, (..., n, n), with these rows as its lower triangle; entries are (...) or numbers."""
    some = next(entry for row in rows for entry in row if isinstance(entry, Tensor))
    lower = [[entry if isinstance(entry, Tensor) else some * 0 + entry for entry in row] for row in rows]
    n = len(lower)
    whole = [[lower[max(i, j)][min(i, j)] for j in range(n)] for i in range(n)]
    return torch.stack([torch.stack(row, dim=-1) for row in whole], dim=-2)


def entry_basis(entries: Entries, functions: int, constants: int) -> tuple[Tensor, Tensor]:
    """What each function and each constant adds to a matrix that is linear in them, as rows.

    (functions, n n) and (constants, n n); found by asking ``entries`` for one at a time.
    """
    f, c = torch.eye(functions).double(), torch.eye(constants).double()
    by_function = entries(f.unbind(), f.new_zeros(constants, functions).unbind())
    by_constant = entries(c.new_zeros(functions, constants).unbind(), c.unbind())
    return by_function.flatten(1), by_constant.flatten(1)
