"""Statistics of one trajectory: its clock, the ranges and the noise of its signals."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from spelgen.logs.trajectory import Trajectory
from spelgen.logs.tuning import is_dense


@dataclass(frozen=True)
class Clock:
    """Sample times of one trajectory.

    duration, longest_gap: [s], the latter 0 without gaps. sample_rate: [Hz], outside gaps. jitter: standard
    deviation of the steps outside gaps, relative to their mean.
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
    """One trajectory of n joints.

    signals: per quantity (see `Trajectory`) an array (4, n): lowest value, highest value, standard deviation of white
    noise (NaN for sparse logs), and quantisation step (NaN for signals that are not quantised).
    """

    clock: Clock
    signals: dict[str, np.ndarray]


def statistics(trajectory: Trajectory) -> Statistics:
    """Return the statistics of one trajectory."""
    # third differences of sparse samples contain the motion
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
    """Return the standard deviation (n,) of white noise on smooth signals (T, n) at jittered times (T,).

    It is computed from third divided differences, which are small for smooth motion, scaled to the standard deviation
    of white noise. The median of their magnitudes is robust against outliers.
    """
    times = sliding_window_view(t, 4)  # (T - 3, 4)
    distances = times[:, :, None] - times[:, None, :] + np.eye(4)
    weights = 1.0 / distances.prod(axis=2)
    weights /= np.linalg.norm(weights, axis=1, keepdims=True)
    differences = np.einsum("tk,tnk->tn", weights, sliding_window_view(values, 4, axis=0))
    # the median of |x| is 0.6745 standard deviations of a normal x
    return np.asarray(np.median(np.abs(differences), axis=0) / 0.6745)


def quantisation_step(values: np.ndarray) -> float:
    """Return the step of a quantised signal (T,); NaN if the signal is not quantised, or constant."""
    differences = np.diff(np.unique(values))
    tolerance = 0.05  # of a step, and of the levels, that may be off the grid
    # two or three levels do not determine a grid
    if len(differences) < 3:
        return float("nan")
    smallest = np.quantile(differences, tolerance)
    step = float(np.median(differences[differences <= 1.5 * smallest]))
    # over a hundred levels the error of the step accumulates to a fraction of a step
    near = differences[differences < 100 * step] / step
    is_whole = np.abs(near - np.round(near)) < tolerance
    is_grid = len(near) > 2 and is_whole.mean() > 1 - tolerance
    # a smooth quantised signal passes neighbouring levels one after the other; commands with round values jump
    changes = np.abs(np.diff(values))
    is_command = has_few_levels(step, float(np.ptp(values))) and changes[changes > 0].mean() > 1.5 * step
    return step if is_grid and not is_command else float("nan")


def has_few_levels(step: float, width: float) -> bool:
    """Whether a signal that is quantised to steps has too few of them in its range for a reliable magnitude."""
    return width < 10.0 * step
