"""Numbers along time: at times between those at which they were found, and over stretches of it."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.special import ndtr, stdtrit

CERTAIN = 2.0  # standard errors that a gain must be large; deviations within which disturbances are usual


def at_times(values: np.ndarray, known: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Values (..., T, n) at times (T,) interpolated at others, (K,): (..., K, n); the nearest beyond both ends."""
    if len(known) == 1:
        return np.repeat(values, len(times), axis=-2)
    found: np.ndarray = make_interp_spline(known, values, k=1, axis=-2)(np.clip(times, known[0], known[-1]))
    return found


def by_stretch(values: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    """Sums over the windows of each stretch of time, (B, ..., T, n), of (..., W, T, n). blocks: (W,) the stretches."""
    member = (blocks == np.arange(blocks.max() + 1)[:, None]).astype(float)
    sums: np.ndarray = np.einsum("bw,...wtn->b...tn", member, values)
    return sums


def certain(stretches: int) -> float:
    """`CERTAIN` standard errors, and more where few stretches of time tell them badly (Student)."""
    return float(-stdtrit(stretches - 1, ndtr(-CERTAIN)))
