"""Velocities and accelerations of recordings that hold positions alone."""

from __future__ import annotations

import numpy as np

from spelgen.logs.trajectory import Trajectory

SMOOTHING = 0.18  # s over which derivatives are taken


def velocities(trajectory: Trajectory) -> np.ndarray:
    """qd (T, n), smoothed."""
    return smoothed(trajectory.q, trajectory.sample_rate)[0]


def smoothed(q: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """First and second derivatives of (..., T, n), by cubic polynomials over `SMOOTHING` (Savitzky and Golay, 1964)."""
    return derivative(q, rate, 1), derivative(q, rate, 2)


def derivative(q: np.ndarray, rate: float, order: int) -> np.ndarray:
    """That of (..., T, n) of this order, 0 for the smoothed values themselves; see `smoothed`."""
    from scipy.signal import savgol_filter  # as in filtering.py

    samples = q.shape[-2]
    width = min(max(5, 2 * round(SMOOTHING * rate / 2) + 1), samples - 1 + samples % 2)
    found: np.ndarray = savgol_filter(q, width, 3, deriv=order, delta=1 / rate, axis=-2)
    return found
