"""Decide what the sample rates of logs allow. No logger's clock is exact, so every bound has a tolerance."""

from __future__ import annotations

from collections.abc import Iterable

from spelgen.settings.tuning.logs import LogTuning

TUNING = LogTuning()
SLOWEST = TUNING.samples_per_period * TUNING.automatic_cutoff  # [Hz] of logs that show accelerations at all
FAST = 1 + TUNING.clock_error


def shows_accelerations(rate: float) -> bool:
    """Whether torques can be fitted to logs of this rate [Hz]: the filter's cutoff must lie below Nyquist's bound."""
    return rate * FAST >= SLOWEST


def is_dense(rate: float) -> bool:
    """Whether the motion between two samples is nearly a line, so that what is left of one is noise."""
    return rate * FAST >= TUNING.dense_rate


def automatic_cutoff(rates: Iterable[float]) -> float | None:
    """Return the cutoff [Hz] of measured logs; None, no filter, where one is too slow to be filtered unasked.

    rates: of the trajectories [Hz].
    """
    dense = all(rate > TUNING.dense_rate * FAST for rate in rates)
    return TUNING.automatic_cutoff if dense else None


def automatic_decimation(rates: Iterable[float], cutoff: float | None) -> int:
    """Return how many samples lie from one sample of a window to the next.

    Every sample counts, unless logs that were filtered at ``cutoff`` are denser than that needs.
    """
    if cutoff is None:
        return 1
    return max(1, int(min(rates) * FAST / (TUNING.samples_per_period * cutoff)))
