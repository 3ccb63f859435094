"""Numbers as JSON has them: five digits, None where not finite."""

from __future__ import annotations

import math

import numpy as np
import torch

Series = list[float | None]
Rows = list[Series]


def number(value: float) -> float | None:
    """Return a number to five digits; None where it is not finite."""
    if math.isfinite(value):
        return float(f"{value:.5g}")
    return None


def series(values: np.ndarray | torch.Tensor) -> Series:
    """Return (T,) as a list."""
    return list(map(number, values.tolist()))


def rows(values: np.ndarray | torch.Tensor) -> Rows:
    """Return (T, n) as a list of lists."""
    return list(map(series, values))


def finite(values: np.ndarray | torch.Tensor) -> tuple[float | None, ...]:
    """Return (T,) as a tuple of exact numbers; None where not finite."""
    return tuple(x if math.isfinite(x) else None for x in values.tolist())
