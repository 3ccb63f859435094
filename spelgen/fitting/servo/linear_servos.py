"""Fit what any model of an arm under position servos has to beat: commands that come late, and linear servos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import expm
from scipy.optimize import least_squares, minimize_scalar

from spelgen.fitting.servo.windows import ServoWindows
from spelgen.logs.commands import LogRows, delayed_commands

LATEST = 0.4  # s, of delays
# logarithms of frequency [rad/s] and damping ratio; delay [s]; offset [rad, m]
START = (np.log(20.0), 0.0, 0.02, 0.0)
BOUNDS = ((-np.inf, -np.inf, 0.0, -np.inf), (np.inf, np.inf, LATEST, np.inf))


@dataclass(frozen=True)
class DelayedCommand:
    """Predict that positions are the commands of ``delay`` [s] ago."""

    delay: float
    about = "the commands themselves, after the delay by which they are nearest to the positions of the training logs"

    def positions(self, parts: Sequence[LogRows], q: np.ndarray, qd: np.ndarray) -> list[np.ndarray]:
        """Return positions (K, n) after each interval of each part of a log."""
        return [delayed_commands(log, rows, self.delay, 1)[:, 0] for log, rows in parts]


@dataclass(frozen=True)
class LinearServos:
    """Predict each joint by itself: qdd = w^2 (u + offset - q) - 2 damping w qd, u commanded ``delay`` [s] ago.

    late: the one delay [s] by which commands themselves are nearest to positions.
    """

    frequency: Sequence[float]
    damping: Sequence[float]
    delay: Sequence[float]
    offset: Sequence[float]
    late: float
    about = "a linear second-order servo at each joint, fitted to windows of the training logs"

    def positions(self, parts: Sequence[LogRows], q: np.ndarray, qd: np.ndarray) -> list[np.ndarray]:
        """Return positions (K, n) after each interval of each part of a log, from q and qd (parts, n)."""
        frequency, damping, result = np.array(self.frequency), np.array(self.damping), []
        for start, speed, (log, rows) in zip(q, qd, parts, strict=True):
            dt = float(np.diff(log.t[rows]).mean())
            columns = [delayed_commands(log, rows, late, 1)[:, 0, k] for k, late in enumerate(self.delay)]
            u = np.stack(columns, axis=-1) + self.offset
            result.append(_rollout(start, speed, u, dt, frequency, damping))
        return result


def fit_linear_servos(windows: ServoWindows) -> LinearServos:
    """Fit commands to all samples of windows, and linear servos to what follows each window's settling."""
    q, qd = windows.q.numpy(), windows.qd.numpy()
    measured, dt = q[:, 1:], float(windows.dt.mean())

    @lru_cache(maxsize=8)  # slopes move one unknown at a time, and the delay is but one of them
    def commands(delay: float) -> np.ndarray:
        return windows.commands(delay).mean(dim=2).numpy()

    def delayed_error(delay: float) -> float:
        return float(np.square(commands(delay) - measured).mean())

    # the error has one minimum: commands move slowly against so short delays
    late = minimize_scalar(delayed_error, bounds=(0, LATEST), method="bounded").x
    fits = []
    for joint in range(q.shape[2]):
        column = slice(joint, joint + 1)

        def residuals(x: np.ndarray, column: slice = column) -> np.ndarray:
            u = commands(x[2])[..., column] + x[3]
            predicted = _rollout(q[:, 0, column], qd[:, 0, column], u, dt, np.exp(x[:1]), np.exp(x[1:2]))
            result: np.ndarray = (predicted - measured[..., column])[:, windows.settling :].ravel()
            return result

        fits.append(least_squares(residuals, START, bounds=BOUNDS, x_scale="jac", max_nfev=30).x)
    columns = np.array(fits).T
    columns[:2] = np.exp(columns[:2])
    frequency, damping, delay, offset = columns.tolist()
    return LinearServos(frequency, damping, delay, offset, float(late))


def _rollout(
    q: np.ndarray, qd: np.ndarray, u: np.ndarray, dt: float, frequency: np.ndarray, damping: np.ndarray
) -> np.ndarray:
    """Return positions (..., K, n) from q and qd (..., n) under u (..., K, n): exactly, where a command is held over
    each step.
    """
    system = np.zeros((len(frequency), 3, 3))  # of position, velocity and command
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
