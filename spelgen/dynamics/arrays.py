"""Functions of single states, as functions of batches of arrays or tensors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np


def by_state(function: Callable[..., np.ndarray], *states: Any) -> Any:
    """``function`` of each state: states (..., n) are arrays or tensors, and what it gives is of their kind.

    Says ``new_tensor``, so that what imports this needs no torch.
    """
    first = states[0]
    if isinstance(first, np.ndarray) and first.ndim == 1:
        return function(*states)
    rows = np.broadcast_arrays(*(np.asarray(x) for x in states))
    batch, n = rows[0].shape[:-1], rows[0].shape[-1]
    found = np.array([function(*each) for each in zip(*(x.reshape(-1, n) for x in rows), strict=True)])
    return like(found.reshape(*batch, *found.shape[1:]), first)


def like(found: np.ndarray, given: Any) -> Any:
    """``found`` as the array or tensor that ``given`` is."""
    return found if isinstance(given, np.ndarray) else given.new_tensor(found)
