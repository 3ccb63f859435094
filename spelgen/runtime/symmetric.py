"""Symmetric matrices written as their lower triangle."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def symmetric(*rows: Sequence[Tensor | float]) -> Tensor:
    """Return the matrix, (..., n, n), with these rows as its lower triangle; entries are (...) or numbers."""
    entries = [entry for row in rows for entry in row]
    like = next(entry for entry in entries if isinstance(entry, Tensor))
    lower = [entry if isinstance(entry, Tensor) else torch.full_like(like, entry) for entry in entries]
    n = len(rows)
    index = [max(i, j) * (max(i, j) + 1) // 2 + min(i, j) for i in range(n) for j in range(n)]
    entries_of_matrix = torch.stack(lower, dim=-1)[..., index]
    return entries_of_matrix.reshape(*like.shape, n, n)
