"""Delayed commands of position servos: each command is held until the next one."""

from __future__ import annotations

import math

import numpy as np

from spelgen.logs.trajectory import Trajectory, require_commands
from spelgen.logs.tuning import SERVO_ROLLOUT

LogRows = tuple[Trajectory, slice]
"""A part of a log: rows from start to stop."""
LEAD_IN = 1e3  # [s] time before a recording during which its first command is assumed to hold


def steps_between(trajectory: Trajectory, longest: float = SERVO_ROLLOUT.step) -> int:
    """Return the number of steps of at most ``longest`` [s] into which the interval between samples is divided."""
    return max(1, math.ceil(1 / (trajectory.sample_rate * longest) - 1e-6))


def delayed_commands(trajectory: Trajectory, rows: slice, delay: float, steps: int) -> np.ndarray:
    """Return the means (K, steps, n) of the delayed commands over the steps between the samples of ``rows``; delay
    [s].

    Means are differentiable with respect to the delay; values at single times are not.
    """
    samples = trajectory.t[rows]
    earliest, latest = np.searchsorted(trajectory.t, samples[[0, -1]] - delay)
    # from the command that was held at that time
    held_rows = slice(max(0, earliest - 1), latest + 1)
    t, u = trajectory.t[held_rows], require_commands(trajectory)[held_rows]
    standing = np.concatenate([u[:1], u[:-1]])  # the command held until each sample
    corners = np.concatenate([t[:1] - LEAD_IN, t])
    integral = np.zeros((len(t) + 1, u.shape[1]))
    integral[1:] = np.cumsum(np.diff(corners)[:, None] * standing, axis=0)
    edges = samples[:-1, None] + np.diff(samples)[:, None] * np.arange(steps) / steps
    edges = np.append(edges.ravel(), samples[-1])
    values = [np.interp(edges - delay, corners, column) for column in integral.T]
    means = np.diff(values) / np.diff(edges)
    return means.T.reshape(len(samples) - 1, steps, -1)
