"""Limits of the sample rates of logs, with a tolerance for inexact clocks."""

from __future__ import annotations

from spelgen.logs.tuning import TUNING

SLOWEST = TUNING.samples_per_period * TUNING.automatic_cutoff  # [Hz] lowest rate for accelerations
FAST = 1 + TUNING.clock_error


def shows_accelerations(rate: float) -> bool:
    """Return True if logs of this rate [Hz] determine accelerations: the filter's cutoff is below Nyquist's bound."""
    return rate * FAST >= SLOWEST


def is_dense(rate: float) -> bool:
    """Return True if linear interpolation between samples suffices at this rate [Hz]."""
    return rate * FAST >= TUNING.dense_rate
