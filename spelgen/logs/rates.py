"""Limits of the sample rates of logs. No logger's clock is exact, so every bound has a tolerance."""

from __future__ import annotations

from spelgen.logs.tuning import TUNING

SLOWEST = TUNING.samples_per_period * TUNING.automatic_cutoff  # [Hz] of logs that show accelerations at all
FAST = 1 + TUNING.clock_error


def shows_accelerations(rate: float) -> bool:
    """Whether torques can be fitted to logs of this rate [Hz]: the filter's cutoff must lie below Nyquist's bound."""
    return rate * FAST >= SLOWEST


def is_dense(rate: float) -> bool:
    """Whether motion between samples is almost linear at this rate [Hz]: differences from a line are noise."""
    return rate * FAST >= TUNING.dense_rate
