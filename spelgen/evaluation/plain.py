"""Conversion of arrays and numbers to JSON: five significant digits, None in place of NaN and infinity."""

import math
from typing import Annotated

import numpy as np
import torch
from pydantic import PlainSerializer, PlainValidator, TypeAdapter


def number(value: float) -> float | None:
    """Return a number for JSON, rounded to five significant digits; None if it is not finite."""
    # JSON has no infinity and no NaN. Five digits exceed the accuracy of every figure, and keep pages small.
    if math.isfinite(value):
        return float(f"{value:.5g}")
    return None


def listed(values: np.ndarray) -> object:
    """Return an array of any shape as nested lists for JSON, with five significant digits, and None if not finite."""
    if values.ndim == 0:
        return number(values.item())
    return list(map(listed, values))


def array(values: object) -> np.ndarray:
    """Return the array of floats that `listed` has converted to nested lists; None becomes NaN."""
    return np.array(values, dtype=float)


Curve = Annotated[np.ndarray, PlainValidator(array), PlainSerializer(listed)]
"""Array along a trajectory, stored in JSON as nested lists."""


def record(value: object) -> dict[str, object]:
    """Return a dataclass as a dict for JSON; `Curve` fields become nested lists of rounded numbers."""
    return dict(TypeAdapter(type(value)).dump_python(value))


def finite(values: np.ndarray | torch.Tensor) -> tuple[float | None, ...]:
    """Return the values of an array (T,) as floats for JSON, not rounded; None in place of NaN and infinity."""
    return tuple(x if math.isfinite(x) else None for x in values.tolist())
