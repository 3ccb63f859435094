"""Predictors of arms under position servos: the delayed command, and a linear second-order servo at each joint."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from spelgen.logs.trajectory import LogRows, delayed_commands


@dataclass(frozen=True)
class DelayedCommand:
    """Predictor whose position at time t is the command at t - delay; ``delay`` in [s]."""

    delay: float
    about = "the commands themselves, after the delay by which they are nearest to the positions of the training logs"

    def positions(self, parts: Sequence[LogRows], q: np.ndarray, qd: np.ndarray) -> list[np.ndarray]:
        """Return the delayed commands at the end of the K sample intervals of each part of a log, (K, n) [rad, m]."""
        return [delayed_commands(log, rows, self.delay, 1)[:, 0] for log, rows in parts]


@dataclass(frozen=True)
class LinearServos:
    """Independent servos of the joints: qdd = w^2 (u(t - delay) + offset - q) - 2 damping w qd.

    frequency: natural frequency w [rad/s]. damping: damping ratio [1]. delay: delay of the command [s]. offset: offset
    of the position [rad, m]. All four have one value per joint. late: delay [s] of `DelayedCommand`, for all joints.
    """

    frequency: Sequence[float]
    damping: Sequence[float]
    delay: Sequence[float]
    offset: Sequence[float]
    late: float
    about = "a linear second-order servo at each joint, fitted to windows of the training logs"

    def positions(self, parts: Sequence[LogRows], q: np.ndarray, qd: np.ndarray) -> list[np.ndarray]:
        """Return second-order responses to the commands at the end of the K sample intervals of each part, (K, n)."""
        frequency, damping, result = np.array(self.frequency), np.array(self.damping), []
        for start, speed, (log, rows) in zip(q, qd, parts, strict=True):
            # The mean interval is used for all steps, so that the exact response is computed only once.
            dt = float(np.diff(log.t[rows]).mean())
            columns = [delayed_commands(log, rows, late, 1)[:, 0, k] for k, late in enumerate(self.delay)]
            u = np.stack(columns, axis=-1) + self.offset
            result.append(linear_response(start, speed, u, dt, frequency, damping))
        return result


def linear_response(
    q: np.ndarray, qd: np.ndarray, u: np.ndarray, dt: float, frequency: np.ndarray, damping: np.ndarray
) -> np.ndarray:
    """Return the positions of second-order servos, exact for commands that are constant in each interval.

    Args:
        q: (..., n) initial positions [rad, m].
        qd: (..., n) initial velocities [rad/s, m/s].
        u: (..., K, n) commands of the K intervals [rad, m].
        dt: length of an interval [s].
        frequency: (n,) natural frequency [rad/s].
        damping: (n,) damping ratio [1].

    Returns:
        (..., K, n) positions at the end of each interval [rad, m].
    """
    system = np.zeros((len(frequency), 3, 3))  # state: position, velocity, command
    system[:, 0, 1] = 1.0
    system[:, 1, 0], system[:, 1, 2] = -(frequency**2), frequency**2
    system[:, 1, 1] = -2 * damping * frequency
    step = expm(system * dt)[:, :2]
    state, positions = np.stack([q, qd, u[..., 0, :]], axis=-1), np.empty_like(u)
    for k in range(u.shape[-2]):
        state[..., 2] = u[..., k, :]
        state[..., :2] = np.einsum("nij,...nj->...ni", step, state)
        positions[..., k, :] = state[..., 0]
    return positions
