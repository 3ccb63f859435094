"""Differentiate recordings that hold positions alone."""

from __future__ import annotations

import numpy as np

from spelgen.logs.trajectory import Trajectory
from spelgen.settings.tuning.logs import LogTuning

TUNING = LogTuning()


def velocities(trajectory: Trajectory) -> np.ndarray:
    """Return qd (T, n), smoothed."""
    return derivative(trajectory.q, trajectory.sample_rate, 1)


def smoothed(q: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Return first and second derivatives of (..., T, n); see `derivative`."""
    return derivative(q, rate, 1), derivative(q, rate, 2)


def derivative(q: np.ndarray, rate: float, order: int) -> np.ndarray:
    """Return the derivative of (..., T, n) at a rate [Hz], of order 0 the smoothed values themselves.

    By cubic polynomials over `derivative_span` (Savitzky and Golay, Anal. Chem. 36, 1964).
    """
    from scipy.signal import savgol_filter  # takes long to import, as in filtering.py

    samples = q.shape[-2]
    width = 2 * round(TUNING.derivative_span * rate / 2) + 1
    # the filter takes odd widths alone: above a cubic's four samples, and no more than there are
    longest = samples - 1 + samples % 2
    width = min(max(5, width), longest)
    derivatives: np.ndarray = savgol_filter(q, width, 3, deriv=order, delta=1 / rate, axis=-2)
    return derivatives
