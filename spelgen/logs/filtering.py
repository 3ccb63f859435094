"""Zero-phase filters, resampling and differentiation of signals."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from spelgen.logs.trajectory import Trajectory
from spelgen.logs.tuning import is_dense

# SciPy is imported in the functions that need it: its import takes most of a second, and few commands need it


def low_pass(trajectory: Trajectory, cutoff: float) -> Trajectory:
    """Return a gap-free piece with q, qd and tau filtered by a zero-phase Butterworth low-pass.

    cutoff [Hz]. All signals have the same filter: filtered input and output of a linear system obey the same equation.
    Raises LogError if the sample rate is too low for this cutoff.
    """
    t = trajectory.t
    require_cutoff(trajectory, _mean_rate(t), cutoff)
    q, qd, tau = (low_passed(t, x, cutoff) for x in (trajectory.q, trajectory.qd, trajectory.tau))
    return replace(trajectory, q=q, qd=qd, tau=tau)


def require_cutoff(trajectory: Trajectory, rate: float, cutoff: float) -> None:
    """Raise LogError if a sample rate [Hz] is too low for a filter with this cutoff [Hz]."""
    if cutoff >= rate / 2:
        got = f"a filter of {cutoff:g} Hz on samples at {rate:.3g} Hz"
        raise trajectory.error(got, f"below {rate / 2:.3g} Hz", "lower or drop the filter")


def low_passed(t: np.ndarray, signals: np.ndarray, cutoff: float) -> np.ndarray:
    """Return signals (T, ...) at times t, filtered by the zero-phase low-pass.

    The filter needs a regular grid: signals are interpolated (cubic) to the mean rate, filtered and interpolated back.
    """
    grid = np.linspace(t[0], t[-1], len(t))
    return interpolated(grid, low_pass_regular(interpolated(t, signals, grid), _mean_rate(t), cutoff), t)


def interpolated(t: np.ndarray, signals: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return signals (T, ...) at times t, interpolated at other times by a cubic; unchanged if the times are equal."""
    if len(t) == len(times) and np.abs(t - times).max() < 1e-6 / _mean_rate(t):
        return signals
    from scipy.interpolate import CubicSpline

    return np.asarray(CubicSpline(t, signals)(times))


def _mean_rate(t: np.ndarray) -> float:
    return float((len(t) - 1) / (t[-1] - t[0]))


def low_pass_regular(signals: np.ndarray, rate: float, cutoff: float) -> np.ndarray:
    """Return signals (T, ...) at a regular rate [Hz], filtered by the zero-phase low-pass."""
    from scipy.signal import sosfiltfilt

    # signals are extended at both ends by three periods of the cutoff
    padding = min(len(signals) - 1, int(3 * rate / cutoff))
    filtered = sosfiltfilt(_sections(rate, cutoff), signals, axis=0, padlen=padding)
    return np.ascontiguousarray(filtered)  # the filter returns a reversed view, which torch does not accept


@lru_cache(maxsize=8)  # logs of a robot have few rates
def _sections(rate: float, cutoff: float) -> np.ndarray:
    """Return the filter's second-order sections (S, 6); their design takes as long as filtering a minute of a joint."""
    from scipy.signal import butter

    # fourth order, run forward and backward as in the logs' published protocols
    return np.asarray(butter(4, cutoff, fs=rate, output="sos"))


def regular_times(t: np.ndarray, frequency: float) -> np.ndarray:
    """Return regular times at a rate [Hz] within the range of times t (T,)."""
    return np.arange(t[0], t[-1], 1.0 / frequency)


def resampled(t: np.ndarray, signals: np.ndarray, times: np.ndarray, rate: float) -> np.ndarray:
    """Return signals (T, ...) of this rate [Hz] at other times, interpolated linearly if dense, else by a cubic."""
    from scipy.interpolate import interp1d

    # a line between samples that are far apart would cut off the peaks of the motion
    kind = "linear" if is_dense(rate) else "cubic"
    # rounding errors may move the last time beyond the last sample
    return np.asarray(interp1d(t, signals, kind, axis=0, fill_value="extrapolate")(times))


def velocities(trajectory: Trajectory) -> np.ndarray:
    """Return qd (T, n), smoothed."""
    return derivative(trajectory.q, trajectory.sample_rate, 1)


def derivative(q: np.ndarray, rate: float, order: int) -> np.ndarray:
    """Return the derivative of q (..., T, n) at a rate [Hz]; of order 0: the smoothed q.

    By cubic polynomials over 0.18 s (Savitzky and Golay, Anal. Chem. 36, 1964).
    """
    from scipy.signal import savgol_filter

    samples = q.shape[-2]
    # the span is a trade-off of noise and lag (SO-101)
    width = 2 * round(0.18 * rate / 2) + 1
    # the width is uneven, at least five samples for a cubic, and at most the number of samples
    width = min(max(5, width), samples - 1 + samples % 2)
    return np.asarray(savgol_filter(q, width, 3, deriv=order, delta=1 / rate, axis=-2))
