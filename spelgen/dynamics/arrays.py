"""Functions of arrays, as functions of arrays or tensors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np


def on_arrays(function: Callable[..., np.ndarray], *states: Any) -> Any:
    """``function`` of states (..., n), which are arrays or tensors of batches that go together; what it gives is of
    their kind.

    Says ``new_tensor``, so that what imports this needs no torch.
    """
    first = states[0]
    if isinstance(first, np.ndarray) and first.ndim == 1:
        return function(*states)
    rows = np.broadcast_arrays(*(np.asarray(x) for x in states))
    return like(function(*rows), first)


def like(result: np.ndarray, like_this: Any) -> Any:
    """``found`` as the array or tensor that ``given`` is."""
    return result if isinstance(like_this, np.ndarray) else like_this.new_tensor(result)
