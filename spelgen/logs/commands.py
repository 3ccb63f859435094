"""Commanded positions between samples, as joints get them: each held until the next, all of them late."""

from __future__ import annotations

import math

import numpy as np

from spelgen.logs.trajectory import Trajectory

EARLIER = 1e3  # s before a recording, over which its first command is taken to have stood


def steps_between(trajectory: Trajectory, longest: float) -> int:
    """Into how many steps of at most ``longest`` [s] the time between samples is to be cut."""
    return max(1, math.ceil(1 / (trajectory.sample_rate * longest) - 1e-6))


def delayed_commands(trajectory: Trajectory, rows: slice, delay: float, steps: int) -> np.ndarray:
    """Means (K, steps, n) of the command of ``delay`` [s] ago over the steps between the samples of ``rows``.

    Means, and not values: so what follows from them is smooth in the delay.
    """
    t, u = trajectory.t, trajectory.u
    assert u is not None
    held = np.concatenate([[EARLIER], np.diff(t)])
    integral = np.concatenate(
        [np.zeros((1, u.shape[1])), np.cumsum(held[:, None] * u[[0, *range(len(t) - 1)]], axis=0)]
    )
    corners = np.concatenate([t[:1] - EARLIER, t])
    now = t[rows]
    edges = now[:-1, None] + np.diff(now)[:, None] * np.arange(steps) / steps
    edges = np.concatenate([edges.ravel(), now[-1:]])
    values = np.stack([np.interp(edges - delay, corners, x) for x in integral.T], axis=1)
    means = np.diff(values, axis=0) / np.diff(edges)[:, None]
    return means.reshape(len(now) - 1, steps, -1)
