"""One trajectory -> numbers about its clock, its ranges and its noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from spelgen.logs.checks import VelocityAgreement, velocity_agreement
from spelgen.logs.trajectory import GAP, QUANTITIES, Trajectory

DENSE = 50.0  # [Hz] below this rate motion looks like noise
SMALLEST = 0.05  # part of the differences between neighbouring levels that may be one step
NEAR = 100.0  # steps
WHOLE = 0.05  # a difference this near to a whole number of steps is that number
FEWEST = 3  # differences between neighbouring levels that tell of steps
MOSTLY = 0.95  # of the differences between neighbouring levels are whole steps where a signal is quantised


@dataclass(frozen=True)
class Clock:
    """When the samples of one trajectory were taken.

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


@dataclass(frozen=True, eq=False)
class Statistics:
    """One trajectory of n joints.

    low, high: of q, qd and tau, each (n,). noise: of q, qd and tau (n,), standard deviation of what changes from
    sample to sample; None where the log is too sparse to tell. steps: of the quantised signals among them (n,),
    NaN where a signal is not.
    """

    clock: Clock
    low: dict[str, np.ndarray]
    high: dict[str, np.ndarray]
    noise: dict[str, np.ndarray] | None
    steps: dict[str, np.ndarray]
    agreement: VelocityAgreement


def statistics(trajectory: Trajectory) -> Statistics:
    """The numbers of one trajectory."""
    signals = {name: getattr(trajectory, name) for name in QUANTITIES}
    dense = trajectory.sample_rate >= DENSE and len(trajectory.t) > 8
    return Statistics(
        clock=clock_of(trajectory),
        low={name: values.min(axis=0) for name, values in signals.items()},
        high={name: values.max(axis=0) for name, values in signals.items()},
        noise={name: noise_level(trajectory.t, values) for name, values in signals.items()}
        if dense
        else None,
        steps={
            name: np.array([quantisation_step(column) for column in values.T])
            for name, values in signals.items()
        },
        agreement=velocity_agreement(trajectory),
    )


def clock_of(trajectory: Trajectory) -> Clock:
    """Of one trajectory."""
    steps = np.diff(trajectory.t)
    regular = steps[steps <= GAP * np.median(steps)] if steps.size else np.ones(1)
    gaps = steps[steps > GAP * np.median(steps)] if steps.size else steps
    return Clock(
        name=trajectory.name,
        file=None if trajectory.file is None else str(trajectory.file),
        samples=len(trajectory.t),
        duration=trajectory.duration,
        sample_rate=trajectory.sample_rate,
        jitter=float(regular.std() / regular.mean()),
        gaps=len(gaps),
        longest_gap=float(gaps.max(initial=0.0)),
    )


def noise_level(t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Standard deviation (n,) of white noise on smooth signals (T, n) at jittered times (T,).

    From third divided differences, scaled so that white noise keeps its size: of smooth motion they are small,
    and the median leaves out the moments at which they are not.
    """
    times = sliding_window_view(t, 4)  # (T - 3, 4)
    apart = times[:, :, None] - times[:, None, :] + np.eye(4)
    weights = 1.0 / apart.prod(axis=2)
    weights /= np.linalg.norm(weights, axis=1, keepdims=True)
    third = np.einsum("tk,tnk->tn", weights, sliding_window_view(values, 4, axis=0))
    return np.median(np.abs(third), axis=0) / 0.6745


def quantisation_step(values: np.ndarray) -> float:
    """The step of a quantised signal (T,); NaN where it is not quantised, or never changes."""
    apart = np.diff(np.unique(values))
    if len(apart) < FEWEST:
        return float("nan")
    step = float(np.median(apart[apart <= 1.5 * np.quantile(apart, SMALLEST)]))
    near = apart[apart < NEAR * step] / step  # far apart, whole steps cannot be told from rounding
    whole = np.abs(near - np.round(near)) < WHOLE
    return step if len(near) >= FEWEST and whole.mean() > MOSTLY else float("nan")


def common_step(steps: Sequence[float]) -> float | None:
    """The step of most trajectories, where the signal is quantised in most of them."""
    known = [step for step in steps if np.isfinite(step)]
    return float(np.median(known)) if 2 * len(known) > len(steps) else None
