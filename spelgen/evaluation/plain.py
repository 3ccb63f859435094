"""Curves, and numbers as JSON has them: five digits, None where not finite."""

from __future__ import annotations

import math
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import PlainSerializer, PlainValidator, TypeAdapter


def number(value: float) -> float | None:
    """Return a number to five digits; None where it is not finite."""
    if math.isfinite(value):
        return float(f"{value:.5g}")
    return None


def listed(values: np.ndarray) -> Any:
    """Return an array as numbers in nested lists."""
    if values.ndim == 0:
        return number(values.item())
    return list(map(listed, values))


def array(values: object) -> np.ndarray:
    """Return what `listed` gave as an array, NaN where not finite."""
    return np.array(values, dtype=float)


Curve = Annotated[np.ndarray, PlainValidator(array), PlainSerializer(listed)]
"""Numbers along a trajectory: an array here, nested lists in JSON."""


def record(value: object) -> dict[str, Any]:
    """Return the JSON form of a dataclass, which may have curves."""
    fields: dict[str, Any] = TypeAdapter(type(value)).dump_python(value)
    return fields


def finite(values: np.ndarray | torch.Tensor) -> tuple[float | None, ...]:
    """Return (T,) as a tuple of exact numbers; None where not finite."""
    return tuple(x if math.isfinite(x) else None for x in values.tolist())
