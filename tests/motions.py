"""Smooth random motions for tests and benchmarks."""

from __future__ import annotations

import numpy as np


def smooth_motion(
    n: int, seconds: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return q, qd and qdd, (T, n) each, at 100 Hz: per joint, the sum of five sines of 0.1 to 0.7 Hz."""
    t = np.arange(0.0, seconds, 0.01)[:, None, None]
    speed, phase = 2 * np.pi * rng.uniform(0.1, 0.7, (5, n)), rng.uniform(0, 2 * np.pi, (5, n))
    size = rng.uniform(0.2, 0.5, (5, n))
    angle = speed * t + phase
    q, qd = (size * np.sin(angle)).sum(1), (size * speed * np.cos(angle)).sum(1)
    return q, qd, -(size * speed**2 * np.sin(angle)).sum(1)
