"""Filter signals with zero phase, bring them to other times, and differentiate recorded positions."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from spelgen.logs.trajectory import Trajectory
from spelgen.logs.tuning import is_dense

# SciPy is imported where it is called: that takes the better part of a second, which most commands can do without


def low_pass(trajectory: Trajectory, cutoff: float) -> Trajectory:
    """Return one gap-free piece with q, qd and tau through a zero-phase Butterworth low-pass.

    cutoff [Hz]. All three go through the same filter, so that a linear system's filtered input still explains its
    filtered output. Raises LogError where the piece is too slow for this cutoff.
    """
    t = trajectory.t
    require_cutoff(trajectory, _mean_rate(t), cutoff)
    q, qd, tau = (low_passed(t, x, cutoff) for x in (trajectory.q, trajectory.qd, trajectory.tau))
    return replace(trajectory, q=q, qd=qd, tau=tau)


def require_cutoff(trajectory: Trajectory, rate: float, cutoff: float) -> None:
    """Raise LogError where samples at this rate [Hz] are too few for a filter of that cutoff [Hz]."""
    if cutoff >= rate / 2:
        got = f"a filter of {cutoff:g} Hz on samples at {rate:.3g} Hz"
        raise trajectory.error(got, f"below {rate / 2:.3g} Hz", "lower or drop the filter")


def low_passed(t: np.ndarray, signals: np.ndarray, cutoff: float) -> np.ndarray:
    """Return signals (T, ...) at times t through that filter.

    It needs a regular grid: they are interpolated (cubic) to the mean rate, filtered and interpolated back.
    """
    grid = np.linspace(t[0], t[-1], len(t))
    return interpolated(grid, low_pass_regular(interpolated(t, signals, grid), _mean_rate(t), cutoff), t)


def interpolated(t: np.ndarray, signals: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return signals (T, ...) at times t at other times, on a cubic; unchanged if the times are the same."""
    if len(t) == len(times) and np.abs(t - times).max() < 1e-6 / _mean_rate(t):
        return signals
    from scipy.interpolate import CubicSpline

    return np.asarray(CubicSpline(t, signals)(times))


def _mean_rate(t: np.ndarray) -> float:
    return float((len(t) - 1) / (t[-1] - t[0]))


def low_pass_regular(signals: np.ndarray, rate: float, cutoff: float) -> np.ndarray:
    """Return signals (T, ...) at a regular rate [Hz] through that filter."""
    from scipy.signal import sosfiltfilt

    # three periods of the cutoff settle the ends
    padding = min(len(signals) - 1, int(3 * rate / cutoff))
    filtered = sosfiltfilt(_sections(rate, cutoff), signals, axis=0, padlen=padding)
    return np.ascontiguousarray(filtered)  # the filter gives a reversed view, which torch does not take


@lru_cache(maxsize=8)  # logs of a robot have few rates
def _sections(rate: float, cutoff: float) -> np.ndarray:
    """Return the filter's second-order sections (S, 6), whose design takes as long as filtering a minute of a joint."""
    from scipy.signal import butter

    # fourth order, run forward and backward as in the logs' published protocols
    return np.asarray(butter(4, cutoff, fs=rate, output="sos"))


def regular_times(t: np.ndarray, frequency: float) -> np.ndarray:
    """Return the times of a regular rate [Hz] within the times t (T,)."""
    return np.arange(t[0], t[-1], 1.0 / frequency)


def resampled(t: np.ndarray, signals: np.ndarray, times: np.ndarray, rate: float) -> np.ndarray:
    """Return signals (T, ...) of that rate [Hz] at other times: between dense samples on lines, else on a cubic."""
    from scipy.interpolate import interp1d

    # a line between samples that are far apart would cut off the peaks of the motion
    kind = "linear" if is_dense(rate) else "cubic"
    # by rounding the last time may lie just behind the last sample
    return np.asarray(interp1d(t, signals, kind, axis=0, fill_value="extrapolate")(times))


def velocities(trajectory: Trajectory) -> np.ndarray:
    """Return qd (T, n), smoothed."""
    return derivative(trajectory.q, trajectory.sample_rate, 1)


def derivative(q: np.ndarray, rate: float, order: int) -> np.ndarray:
    """Return the derivative of (..., T, n) at a rate [Hz], of order 0 the smoothed values themselves.

    By cubic polynomials over 0.18 s (Savitzky and Golay, Anal. Chem. 36, 1964).
    """
    from scipy.signal import savgol_filter

    samples = q.shape[-2]
    # the span is a trade-off of noise and lag (SO-101)
    width = 2 * round(0.18 * rate / 2) + 1
    # an uneven width above the four samples of a cubic, at most the number of samples
    width = min(max(5, width), samples - 1 + samples % 2)
    return np.asarray(savgol_filter(q, width, 3, deriv=order, delta=1 / rate, axis=-2))
