"""Symmetric matrices from their lower triangle."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def symmetric(*rows: Sequence[Tensor | float]) -> Tensor:
    """Return the symmetric matrix, (..., n, n), of the rows of its lower triangle: (...) or numbers."""
    n = len(rows)
    entries = [rows[max(i, j)][min(i, j)] for i in range(n) for j in range(n)]
    like = next(entry for entry in entries if isinstance(entry, Tensor))
    filled = [entry if isinstance(entry, Tensor) else torch.full_like(like, entry) for entry in entries]
    return torch.stack(filled, dim=-1).reshape(*like.shape, n, n)
