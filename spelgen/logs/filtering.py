"""Prepare trajectories to be computed with: cut at gaps, filtered with zero phase, resampled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from spelgen.errors import SpelgenError, collect
from spelgen.logs.rates import is_dense
from spelgen.logs.trajectory import GAP, Trajectory, split_at_gaps
from spelgen.settings.tuning.logs import LogTuning

TUNING = LogTuning()


def low_pass(trajectory: Trajectory, cutoff: float) -> Trajectory:
    """Return one gap-free piece with q, qd and tau through a zero-phase Butterworth low-pass.

    cutoff [Hz]. All three go through the same filter, so that a linear system's filtered input still explains its
    filtered output. Raises LogError where the piece is too slow for this cutoff.
    """
    require_cutoff(trajectory, _mean_rate(trajectory.t), cutoff)
    signals = trajectory.q, trajectory.qd, trajectory.tau
    q, qd, tau = (low_passed(trajectory.t, x, cutoff) for x in signals)
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


def interpolated(t: np.ndarray, signals: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return signals (T, ...) at times t at other times, on a cubic; as they are where these are the same times."""
    if len(t) == len(at) and np.abs(t - at).max() < 1e-6 / _mean_rate(t):
        return signals
    from scipy.interpolate import CubicSpline  # takes long to import, as in `low_pass_regular`

    values: np.ndarray = CubicSpline(t, signals)(at)
    return values


def _mean_rate(t: np.ndarray) -> float:
    return float((len(t) - 1) / (t[-1] - t[0]))


def low_pass_regular(signals: np.ndarray, rate: float, cutoff: float) -> np.ndarray:
    """Return signals (T, ...) at a regular rate [Hz] through that filter."""
    # to import it takes the better part of a second, which most commands can do without
    from scipy.signal import sosfiltfilt

    # three periods of the cutoff settle the ends
    padding = min(len(signals) - 1, int(3 * rate / cutoff))
    filtered = sosfiltfilt(_sections(rate, cutoff), signals, axis=0, padlen=padding)
    return np.ascontiguousarray(filtered)  # the filter gives a reversed view, which torch does not take


@lru_cache(maxsize=8)  # logs of a robot have few rates
def _sections(rate: float, cutoff: float) -> np.ndarray:
    """Return the filter's second-order sections: to design them takes as long as to filter a minute of a joint."""
    from scipy.signal import butter

    sections: np.ndarray = butter(TUNING.filter_order, cutoff, fs=rate, output="sos")
    return sections


def regular_times(t: np.ndarray, frequency: float) -> np.ndarray:
    """Return the times of a regular rate [Hz] within the times t."""
    return np.arange(t[0], t[-1], 1.0 / frequency)


def resampled(t: np.ndarray, signals: np.ndarray, at: np.ndarray, rate: float) -> np.ndarray:
    """Return signals (T, ...) of that rate [Hz] at other times: between dense samples on lines, else on a cubic."""
    from scipy.interpolate import interp1d  # takes long to import, as in `low_pass_regular`

    # a line between samples that are far apart would cut off the peaks of the motion
    kind = "linear" if is_dense(rate) else "cubic"
    # by rounding the last time may lie just behind the last sample
    values: np.ndarray = interp1d(t, signals, kind, axis=0, fill_value="extrapolate")(at)
    return values


def prepare(
    trajectories: Sequence[Trajectory], *, shortest: int, cutoff: float | None, gap: float = GAP
) -> list[Trajectory]:
    """Return gap-free pieces (see `gap_ends`) of at least `shortest` samples, filtered at cutoff [Hz] if there is one.

    Raises LogError when a trajectory holds no piece that long.
    """
    prepared: list[Trajectory] = []
    errors: list[SpelgenError] = []
    for trajectory in trajectories:
        pieces = split_at_gaps(trajectory, gap)
        long_enough = [piece for piece in pieces if len(piece) >= shortest]
        if not long_enough:
            got = f"{max(map(len, pieces))} samples without a gap"
            do = "record longer or train with a shorter window"
            errors.append(trajectory.error(got, f"at least {shortest}, one window", do))
        for piece in long_enough:
            prepared.append(piece if cutoff is None else low_pass(piece, cutoff))
    collect(errors)
    return prepared


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
    from scipy.signal import savgol_filter  # takes long to import, as in `low_pass_regular`

    samples = q.shape[-2]
    width = 2 * round(TUNING.derivative_span * rate / 2) + 1
    # the filter takes odd widths alone: above a cubic's four samples, and no more than there are
    longest = samples - 1 + samples % 2
    width = min(max(5, width), longest)
    derivatives: np.ndarray = savgol_filter(q, width, 3, deriv=order, delta=1 / rate, axis=-2)
    return derivatives
