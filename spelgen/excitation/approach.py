"""The approach from a given position to the first position of a motion, along a straight line in joint space."""

from __future__ import annotations

from math import ceil, sqrt

import numpy as np

from spelgen.excitation.trajectory import Motion

# largest first and second derivative of 10 s^3 - 15 s^4 + 6 s^5 over s in 0..1
PEAK_SPEED, PEAK_ACCELERATION = 1.875, 10 / sqrt(3)


def approach(
    start: np.ndarray, end: np.ndarray, speed: np.ndarray, acceleration: np.ndarray, sample_rate: float
) -> Motion:
    """Return the fastest motion from rest at `start` to rest at `end` by a polynomial of degree 5.

    All joints move at the same time.

    Args:
        start, end: (n,) [rad, m].
        speed: largest speeds, (n,) [rad/s, m/s].
        acceleration: largest accelerations, (n,) [rad/s^2, m/s^2].
        sample_rate: approximate [Hz].
    """
    distance = end - start
    by_speed = (PEAK_SPEED * np.abs(distance) / speed).max()
    by_acceleration = np.sqrt(PEAK_ACCELERATION * np.abs(distance) / acceleration).max()
    duration = float(max(by_speed, by_acceleration))
    t = np.linspace(0.0, duration, ceil(duration * sample_rate) + 1)
    s = t / (duration or 1.0)
    position = s**3 * (10 - 15 * s + 6 * s**2)
    velocity = 30 * s**2 * (1 - s) ** 2 / (duration or 1.0)
    second = 60 * s * (1 - s) * (1 - 2 * s) / (duration or 1.0) ** 2
    return Motion(
        t, start + np.outer(position, distance), np.outer(velocity, distance), np.outer(second, distance)
    )
