"""Predictors of the motion of an arm under position servos: the delayed command, and linear second-order servos."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from spelgen.logs.trajectory import LogRows, delayed_commands


@dataclass(frozen=True)
class DelayedCommand:
    """Predictor of joint positions: the position at time t is the command at time t - delay. delay: [s]."""

    delay: float

    def positions(self, segments: Sequence[LogRows], q: np.ndarray, qd: np.ndarray) -> list[np.ndarray]:
        """Return the delayed commands as predicted positions, (K, n) [rad, m] per segment of K sample intervals.

        segments: the segments, (log, slice of its samples) each. The initial states q and qd are not used.
        """
        return [delayed_commands(log, rows, self.delay, 1)[:, 0] for log, rows in segments]


@dataclass(frozen=True)
class LinearServos:
    """Independent servos of the joints: qdd = w^2 (u(t - delay) + offset - q) - 2 damping w qd.

    Attributes:
        frequency: Natural frequency w of each joint, (n,) [rad/s].
        damping: Damping ratio of each joint, (n,) [1].
        delay: Delay of the command of each joint, (n,) [s].
        offset: Offset of the position of each joint, (n,) [rad, m].
        late: Delay of the baseline `DelayedCommand`, the same for all joints [s]. A run stores the parameters of both
            baselines in one record.
    """

    frequency: Sequence[float]
    damping: Sequence[float]
    delay: Sequence[float]
    offset: Sequence[float]
    late: float

    def positions(self, segments: Sequence[LogRows], q: np.ndarray, qd: np.ndarray) -> list[np.ndarray]:
        """Return the predicted positions, (K, n) [rad, m] per segment of K sample intervals.

        Args:
            segments: the segments, (log, slice of its samples) each.
            q: (segments, n) initial positions [rad, m].
            qd: (segments, n) initial velocities [rad/s, m/s].
        """
        frequency, damping, result = np.array(self.frequency), np.array(self.damping), []
        for start, speed, (log, rows) in zip(q, qd, segments, strict=True):
            # All sample intervals are replaced by their mean, so that one transition matrix serves for all intervals.
            dt = float(np.diff(log.t[rows]).mean())
            columns = [delayed_commands(log, rows, late, 1)[:, 0, k] for k, late in enumerate(self.delay)]
            u = np.stack(columns, axis=-1) + self.offset
            result.append(linear_response(start, speed, u, dt, frequency, damping))
        return result


def linear_response(
    q: np.ndarray, qd: np.ndarray, u: np.ndarray, dt: float, frequency: np.ndarray, damping: np.ndarray
) -> np.ndarray:
    """Return the positions of independent servos with q'' = frequency^2 (u - q) - 2 damping frequency q'.

    The solution is exact for commands u that are constant in each interval.

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
    # system: (n, 3, 3), matrix A of x' = A x, with the state x = (position, velocity, command)
    system = np.zeros((len(frequency), 3, 3))
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
