"""Functions of arrays, as functions of arrays or tensors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar, cast

import numpy as np

Array = TypeVar("Array")
"""numpy.ndarray or torch.Tensor: a result is of the kind of the arguments."""


class Tensor(Protocol):
    """What is needed of a torch.Tensor: what imports this knows no torch."""

    def new_tensor(self, data: np.ndarray) -> object:
        """Return a tensor of this one's type."""


def on_arrays(function: Callable[..., np.ndarray], *states: Array) -> Array:
    """Return ``function`` of states (..., n), arrays or tensors of batches that go together, as their kind."""
    first = states[0]
    if isinstance(first, np.ndarray) and first.ndim == 1:
        return cast("Array", function(*states))
    result = function(*np.broadcast_arrays(*map(np.asarray, states)))
    if isinstance(first, np.ndarray):
        return cast("Array", result)
    return cast("Array", cast("Tensor", first).new_tensor(result))
