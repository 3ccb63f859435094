"""Trajectories -> what can be computed with: cut at gaps, filtered with zero phase, differentiated, resampled."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from spelgen.errors import LogError, SpelgenError, collect
from spelgen.logs.trajectory import GAP, QUANTITIES, Trajectory, split_at_gaps

FILTER_ORDER = 4
AUTOMATIC_CUTOFF = 8.0  # [Hz] rigid-body motion of an arm lies below, drive ripple and quantisation above
AUTOMATIC_RATE = 50.0  # [Hz] logs sampled more slowly are not oversampled enough to be filtered unasked

SAMPLES_PER_PERIOD = 3


def automatic_cutoff(rates: Iterable[float]) -> float | None:
    """8 Hz when every log is sampled above 50 Hz, as measured logs usually are; otherwise None, no filter.

    rates: of the trajectories [Hz].
    """
    return AUTOMATIC_CUTOFF if all(each > AUTOMATIC_RATE for each in rates) else None


def automatic_decimation(rates: Iterable[float], cutoff: float | None) -> int:
    """Samples from one sample of a window to the next: every one, unless filtered logs are much denser than
    needed.

    What was filtered at `cutoff` is fully described by three samples per period of it.
    """
    if cutoff is None:
        return 1
    return max(1, int(min(rates) / (SAMPLES_PER_PERIOD * cutoff)))


def low_pass(trajectory: Trajectory, cutoff: float) -> Trajectory:
    """One gap-free piece with q, qd and tau through a zero-phase Butterworth low-pass (order 4, both ways).

    cutoff [Hz]. The filter needs a regular grid: the signals are interpolated (cubic) to the piece's mean
    rate, filtered and interpolated back, so that the result stands at the log's own times. All three go
    through the same filter, so that a linear system's filtered input still explains its filtered output.
    """
    from scipy.interpolate import CubicSpline  # as in `low_pass_regular`

    t = trajectory.t
    mean_rate = (len(t) - 1) / (t[-1] - t[0])
    if cutoff >= mean_rate / 2:
        raise LogError(
            f"a filter of {cutoff:g} Hz on samples at {mean_rate:.3g} Hz", file=trajectory.file,
            element=f"trajectory {trajectory.name}", expected=f"below {mean_rate / 2:.3g} Hz",
            do="lower or drop the filter",
        )  # fmt: skip
    signals = np.concatenate([trajectory.q, trajectory.qd, trajectory.tau], axis=1)  # (T, 3n)
    grid = np.linspace(t[0], t[-1], len(t))
    filtered = low_pass_regular(CubicSpline(t, signals)(grid), mean_rate, cutoff)
    q, qd, tau = np.split(CubicSpline(grid, filtered)(t), 3, axis=1)
    return replace(trajectory, q=q, qd=qd, tau=tau)


def low_pass_regular(signals: np.ndarray, rate: float, cutoff: float) -> np.ndarray:
    """Signals (T, ...) at a regular rate [Hz] through that filter."""
    # the better part of a second, which most commands can do without
    from scipy.signal import butter, sosfiltfilt

    sections = butter(FILTER_ORDER, cutoff, fs=rate, output="sos")
    padding = min(len(signals) - 1, int(3 * rate / cutoff))  # three periods of the cutoff settle the ends
    filtered: np.ndarray = sosfiltfilt(sections, signals, axis=0, padlen=padding)
    return filtered


def resample(trajectory: Trajectory, frequency: float) -> Trajectory:
    """One gap-free piece at a regular rate [Hz], by linear interpolation."""
    t = np.arange(trajectory.t[0], trajectory.t[-1], 1.0 / frequency)
    q, qd, tau = (_interpolate(t, trajectory.t, getattr(trajectory, name)) for name in QUANTITIES)
    return replace(trajectory, t=t, q=q, qd=qd, tau=tau)


def _interpolate(t: np.ndarray, times: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(t, times, column) for column in values.T], axis=1)


def prepare(
    trajectories: Sequence[Trajectory], *, shortest: int, cutoff: float | None, gap: float = GAP
) -> list[Trajectory]:
    """Gap-free pieces (see `gap_ends`) of at least `shortest` samples, filtered at cutoff [Hz] if one is given.

    Raises LogError when a trajectory holds no piece that long.
    """
    prepared: list[Trajectory] = []
    errors: list[SpelgenError] = []
    for trajectory in trajectories:
        pieces = [x for x in split_at_gaps(trajectory, gap) if len(x.t) >= shortest]
        if not pieces:
            errors.append(_too_short(trajectory, shortest, gap))
        prepared += pieces if cutoff is None else [low_pass(piece, cutoff) for piece in pieces]
    collect(errors)
    return prepared


def _too_short(trajectory: Trajectory, shortest: int, gap: float) -> LogError:
    longest = max(len(piece.t) for piece in split_at_gaps(trajectory, gap))
    return LogError(
        f"{longest} samples without a gap", file=trajectory.file, element=f"trajectory {trajectory.name}",
        expected=f"at least {shortest}, one window", do="record longer or train with a shorter window",
    )  # fmt: skip
