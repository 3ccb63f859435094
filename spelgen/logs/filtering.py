"""Prepare trajectories to be computed with: cut at gaps, filtered with zero phase, resampled."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from spelgen.errors import LogError, SpelgenError, collect
from spelgen.logs.trajectory import GAP, Trajectory, split_at_gaps
from spelgen.settings.tuning.logs import LogTuning

TUNING = LogTuning()


def automatic_cutoff(rates: Iterable[float]) -> float | None:
    """Return the cutoff [Hz] of measured logs; None, no filter, where one is too slow to be filtered unasked.

    rates: of the trajectories [Hz].
    """
    dense = all(rate > TUNING.dense_rate for rate in rates)
    return TUNING.automatic_cutoff if dense else None


def automatic_decimation(rates: Iterable[float], cutoff: float | None) -> int:
    """Return how many samples lie from one sample of a window to the next.

    Every sample counts, unless logs that were filtered at ``cutoff`` are denser than that needs.
    """
    if cutoff is None:
        return 1
    return max(1, int(min(rates) / (TUNING.samples_per_period * cutoff)))


def low_pass(trajectory: Trajectory, cutoff: float) -> Trajectory:
    """Return one gap-free piece with q, qd and tau through a zero-phase Butterworth low-pass.

    cutoff [Hz]. The filter needs a regular grid: the signals are interpolated (cubic) to the piece's mean
    rate, filtered and interpolated back, so that the result stands at the log's own times. All three go
    through the same filter, so that a linear system's filtered input still explains its filtered output.
    Raises LogError where the piece is too slow for this cutoff.
    """
    from scipy.interpolate import CubicSpline  # takes long to import, as in `low_pass_regular`

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
    """Return signals (T, ...) at a regular rate [Hz] through that filter."""
    # to import it takes the better part of a second, which most commands can do without
    from scipy.signal import butter, sosfiltfilt

    sections = butter(TUNING.filter_order, cutoff, fs=rate, output="sos")
    # three periods of the cutoff settle the ends
    padding = min(len(signals) - 1, int(3 * rate / cutoff))
    filtered: np.ndarray = sosfiltfilt(sections, signals, axis=0, padlen=padding)
    return filtered


def resample(trajectory: Trajectory, frequency: float) -> Trajectory:
    """Return one gap-free piece at a regular rate [Hz], by linear interpolation."""
    t = np.arange(trajectory.t[0], trajectory.t[-1], 1.0 / frequency)

    def at_new_times(values: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(t, trajectory.t, column) for column in values.T], axis=1)

    q, qd, tau = (at_new_times(x) for x in (trajectory.q, trajectory.qd, trajectory.tau))
    return replace(trajectory, t=t, q=q, qd=qd, tau=tau)


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
            errors.append(LogError(
                f"{max(map(len, pieces))} samples without a gap", file=trajectory.file,
                element=f"trajectory {trajectory.name}", expected=f"at least {shortest}, one window",
                do="record longer or train with a shorter window",
            ))  # fmt: skip
        for piece in long_enough:
            prepared.append(piece if cutoff is None else low_pass(piece, cutoff))
    collect(errors)
    return prepared
