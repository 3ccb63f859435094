"""Arrays and numbers in JSON: five digits, None if not finite."""

import math
from typing import Annotated

import numpy as np
import torch
from pydantic import PlainSerializer, PlainValidator, TypeAdapter


def number(value: float) -> float | None:
    """Return a number rounded to five digits; None if it is not finite."""
    # JSON has neither infinity nor NaN; five digits are more than any figure is known to, and keep pages small
    if math.isfinite(value):
        return float(f"{value:.5g}")
    return None


def listed(values: np.ndarray) -> object:
    """Return an array (...,) as nested lists of numbers."""
    if values.ndim == 0:
        return number(values.item())
    return list(map(listed, values))


def array(values: object) -> np.ndarray:
    """Return the array (...,) of nested lists of `listed`; NaN for None."""
    return np.array(values, dtype=float)


Curve = Annotated[np.ndarray, PlainValidator(array), PlainSerializer(listed)]
"""An array along a trajectory; nested lists in JSON."""


def record(value: object) -> dict[str, object]:
    """Return the JSON form of a dataclass with numbers and curves."""
    return dict(TypeAdapter(type(value)).dump_python(value))


def finite(values: np.ndarray | torch.Tensor) -> tuple[float | None, ...]:
    """Return the numbers of (T,) unrounded; None for nan and inf."""
    return tuple(x if math.isfinite(x) else None for x in values.tolist())
