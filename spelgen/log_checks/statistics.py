"""Statistics of one trajectory: sample times, and the ranges, noise and quantisation steps of the signals."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from spelgen.logs.trajectory import Trajectory
from spelgen.logs.tuning import is_dense


@dataclass(frozen=True)
class Clock:
    """Sample times of one trajectory.

    Attributes:
        name: name of the trajectory.
        file: path of the log; None if the trajectory was not read from a file.
        samples: number of samples.
        duration: time from the first to the last sample [s].
        sample_rate: sample rate outside gaps [Hz].
        jitter: standard deviation of the time steps outside gaps, divided by their mean.
        gaps: number of gaps.
        longest_gap: duration of the longest gap [s]; 0 if there is none.
    """

    name: str
    file: str | None
    samples: int
    duration: float
    sample_rate: float
    jitter: float
    gaps: int
    longest_gap: float


class Statistics(NamedTuple):
    """Statistics of one trajectory of n joints.

    clock: statistics of the sample times. signals: for each of "q", "qd" and "tau" or "u" an array (4, n) with the
    lowest value, the highest value, the standard deviation of white noise (NaN below 50 Hz), and the quantisation step
    (NaN for signals that are not quantised).
    """

    clock: Clock
    signals: dict[str, np.ndarray]


def statistics(trajectory: Trajectory) -> Statistics:
    """Return statistics of one trajectory: sample times, and range, noise and quantisation step of each signal."""
    # Noise is estimated only for dense samples: at low sample rates the third differences also contain the motion.
    dense = is_dense(trajectory.sample_rate) and len(trajectory) > 8
    signals = {}
    for name in trajectory.quantities:
        values: np.ndarray = getattr(trajectory, name)
        noise = noise_level(trajectory.t, values) if dense else np.full(values.shape[1], np.nan)
        steps = list(map(quantisation_step, values.T))
        signals[name] = np.array([values.min(axis=0), values.max(axis=0), noise, steps])
    regular = trajectory.regular_steps
    gaps = len(trajectory) - 1 - len(regular)
    clock = Clock(
        name=trajectory.name,
        file=None if trajectory.file is None else str(trajectory.file),
        samples=len(trajectory),
        duration=trajectory.duration,
        sample_rate=trajectory.sample_rate,
        jitter=float(regular.std() / regular.mean()) if regular.size else 0.0,
        gaps=gaps,
        longest_gap=float(np.diff(trajectory.t).max()) if gaps else 0.0,
    )
    return Statistics(clock, signals)


def noise_level(t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the standard deviation (n,) of the white noise on smooth signals `values` (T, n) at times t (T,) [s].

    The noise is computed from third divided differences, which are small for smooth motion and valid for uneven time
    steps. They are normalised, so that white noise has the same standard deviation in them as in the signal. The median
    of their magnitudes is robust against outliers.
    """
    times = sliding_window_view(t, 4)  # times: (T - 3, 4), the times of each four successive samples
    distances = times[:, :, None] - times[:, None, :] + np.eye(4)
    weights = 1.0 / distances.prod(axis=2)
    weights /= np.linalg.norm(weights, axis=1, keepdims=True)
    differences = np.einsum("tk,tnk->tn", weights, sliding_window_view(values, 4, axis=0))
    # For normally distributed noise, the median of the magnitudes is 0.6745 standard deviations.
    return np.asarray(np.median(np.abs(differences), axis=0) / 0.6745)


def quantisation_step(values: np.ndarray) -> float:
    """Return the quantisation step of a signal (T,); NaN if the signal is constant or not quantised."""
    differences = np.diff(np.unique(values))
    # Differences below 1e-9 of the largest value are rounding errors, for example of a unit conversion.
    differences = differences[differences > 1e-9 * np.abs(values).max(initial=0.0)]
    # `tolerance` is used twice. A difference of two levels counts as a multiple of the step if its distance from the
    # nearest multiple is less than 5 % of a step. At most 5 % of the differences may be no multiples.
    tolerance = 0.05
    # Two or three levels are multiples of some step by chance.
    if len(differences) < 3:
        return float("nan")
    smallest = np.quantile(differences, tolerance)
    step = float(np.median(differences[differences <= 1.5 * smallest]))
    # `near`: differences below 100 steps, divided by the step. In larger differences, the error of the estimated step
    # is multiplied by more than 100 and may reach a considerable fraction of a step.
    near = differences[differences < 100 * step] / step
    is_whole = np.abs(near - np.round(near)) < tolerance
    is_grid = len(near) > 2 and is_whole.mean() > 1 - tolerance
    # A quantised measurement changes mostly from one level to a neighbouring level. A signal with few levels that often
    # changes by several levels at once is a command with rounded values, which does not count as quantised.
    changes = np.abs(np.diff(values))
    is_command = has_few_levels(step, float(np.ptp(values))) and changes[changes > 0].mean() > 1.5 * step
    return step if is_grid and not is_command else float("nan")


def has_few_levels(step: float, width: float) -> bool:
    """Return True if the range `width` of a quantised signal has fewer than ten steps, so that it is not resolved."""
    return width < 10.0 * step
