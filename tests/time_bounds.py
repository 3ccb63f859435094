"""Bounds of processor time that are valid on machines of any speed.

A bound is stated in seconds of a reference machine (a laptop of 2024), on which the loop ``_loop`` takes REFERENCE
seconds. On a slower or busy machine the bound grows in proportion to the current duration of ``_loop``.
"""

from __future__ import annotations

import statistics
import time

REFERENCE = 0.04  # [s] duration of ``_loop`` on the reference machine


def in_time(seconds: float, bound: float) -> bool:
    """Return True if a duration is below a bound, with the bound multiplied by `slowness` on a slower machine.

    seconds: measured processor time [s]. bound: largest processor time on the reference machine [s].
    """
    return seconds < bound or seconds < bound * slowness()


def slowness() -> float:
    """Return the current duration of ``_loop`` relative to the reference machine; at least 1."""
    return max(1.0, statistics.median(_loop() for _ in range(5)) / REFERENCE)


def _loop() -> float:
    begin = time.process_time()
    total = 0
    for number in range(1_000_000):
        total += number * number
    return time.process_time() - begin
