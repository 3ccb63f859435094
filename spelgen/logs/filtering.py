"""Zero-phase filters, resampling and differentiation of signals."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from spelgen.logs.trajectory import Trajectory
from spelgen.logs.tuning import is_dense

# SciPy is imported within functions, since its import takes most of a second, and few commands need it.


def low_pass(trajectory: Trajectory, cutoff: float) -> Trajectory:
    """Return a gap-free trajectory with q, qd and tau filtered by a zero-phase Butterworth low-pass.

    cutoff: cutoff frequency [Hz]. All signals have the same filter, since the equation of a linear system remains
    valid if its input and output are filtered equally. Raises LogError if the sample rate is too low for this cutoff.
    """
    t = trajectory.t
    require_cutoff(trajectory, _mean_rate(t), cutoff)
    q, qd, tau = (low_passed(t, x, cutoff) for x in (trajectory.q, trajectory.qd, trajectory.tau))
    return replace(trajectory, q=q, qd=qd, tau=tau)


def require_cutoff(trajectory: Trajectory, rate: float, cutoff: float) -> None:
    """Raise LogError about `trajectory` if its sample rate [Hz] is too low for a filter with this cutoff [Hz]."""
    if cutoff >= rate / 2:
        got = f"a filter of {cutoff:g} Hz on samples at {rate:.3g} Hz"
        raise trajectory.error(got, f"below {rate / 2:.3g} Hz", "lower or drop the filter")


def low_passed(t: np.ndarray, signals: np.ndarray, cutoff: float) -> np.ndarray:
    """Return signals (T, ...) at times t (T,) [s], filtered by the zero-phase low-pass with a cutoff [Hz].

    The filter needs a regular grid: the signals are interpolated by a cubic spline to the mean rate, filtered, and
    interpolated back to the times t.
    """
    grid = np.linspace(t[0], t[-1], len(t))
    return interpolated(grid, low_pass_regular(interpolated(t, signals, grid), _mean_rate(t), cutoff), t)


def interpolated(t: np.ndarray, signals: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return signals (T, ...), sampled at times t (T,) [s], interpolated by a cubic spline at `times` (S,): (S, ...).

    If t and `times` are equal, the signals are returned unchanged.
    """
    if len(t) == len(times) and np.abs(t - times).max() < 1e-6 / _mean_rate(t):
        return signals
    from scipy.interpolate import CubicSpline

    return np.asarray(CubicSpline(t, signals)(times))


def _mean_rate(t: np.ndarray) -> float:
    return float((len(t) - 1) / (t[-1] - t[0]))


def low_pass_regular(signals: np.ndarray, rate: float, cutoff: float) -> np.ndarray:
    """Return signals (T, ...) with a sample rate [Hz], filtered by the zero-phase low-pass with a cutoff [Hz]."""
    from scipy.signal import sosfiltfilt

    # Signals are extended at both ends by three periods of the cutoff frequency, to reduce the filter's transients.
    padding = min(len(signals) - 1, int(3 * rate / cutoff))
    filtered = sosfiltfilt(_sections(rate, cutoff), signals, axis=0, padlen=padding)
    return np.ascontiguousarray(filtered)  # sosfiltfilt returns a reversed view, which torch rejects


# Filters are cached, because the design of a filter takes as long as filtering one minute of a joint, and the logs of a
# robot have few sample rates.
@lru_cache(maxsize=8)
def _sections(rate: float, cutoff: float) -> np.ndarray:
    """Return the S second-order sections, (S, 6), of the Butterworth filter for a sample rate and a cutoff [Hz]."""
    from scipy.signal import butter

    # The low-pass filter has the order 4 and is applied forward and backward, as in the papers that published the
    # recorded logs on which this package is evaluated.
    return np.asarray(butter(4, cutoff, fs=rate, output="sos"))


def regular_times(t: np.ndarray, frequency: float) -> np.ndarray:
    """Return evenly spaced times [s] with the rate `frequency` [Hz], within the range of the times t (T,) [s]."""
    return np.arange(t[0], t[-1], 1.0 / frequency)


def resampled(t: np.ndarray, signals: np.ndarray, times: np.ndarray, rate: float) -> np.ndarray:
    """Return signals (T, ...), sampled at times t (T,) [s], interpolated at the S other `times` [s]: (S, ...).

    rate: sample rate of the signals [Hz]. From 50 Hz the interpolation is linear, below 50 Hz it is cubic.
    """
    from scipy.interpolate import interp1d

    # Signals below 50 Hz are interpolated by cubic functions: linear ones would cut off the peaks of the motion.
    kind = "linear" if is_dense(rate) else "cubic"
    # The interpolation may extrapolate, because by rounding errors the last time may be after the last sample.
    return np.asarray(interp1d(t, signals, kind, axis=0, fill_value="extrapolate")(times))


def velocities(trajectory: Trajectory) -> np.ndarray:
    """Return smoothed velocities (T, n) [rad/s, m/s], differentiated from the positions of a trajectory."""
    return derivative(trajectory.q, trajectory.sample_rate, 1)


def derivative(q: np.ndarray, rate: float, order: int) -> np.ndarray:
    """Return the smoothed time derivative (..., T, n) of positions q (..., T, n) at a sample rate [Hz].

    The derivative is computed from local cubic polynomials over 0.18 s (Savitzky and Golay, Anal. Chem. 36, 1964).
    order: order of the derivative; 0: smoothed positions.
    """
    from scipy.signal import savgol_filter

    samples = q.shape[-2]
    # The span of the polynomials, 0.18 s, was chosen on logs of an SO-101: with shorter spans the derivative is
    # noisier, longer spans smooth the motion.
    width = 2 * round(0.18 * rate / 2) + 1
    # The Savitzky-Golay filter needs a width of 2 k + 1 samples: at least five for a cubic, and at most the number of
    # samples.
    width = min(max(5, width), samples - 1 + samples % 2)
    return np.asarray(savgol_filter(q, width, 3, deriv=order, delta=1 / rate, axis=-2))
