"""Numbers that were found at some times ahead, at others."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import make_interp_spline


def at_times(values: np.ndarray, known: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Values (..., T, n) at times (T,) interpolated at others, (K,): (..., K, n); the nearest beyond both ends."""
    if len(known) == 1:
        return np.repeat(values, len(times), axis=-2)
    found: np.ndarray = make_interp_spline(known, values, k=1, axis=-2)(np.clip(times, known[0], known[-1]))
    return found
