"""Fit the baselines of arms under position servos: the delayed command, and linear second-order servos."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.optimize import least_squares, minimize_scalar

from spelgen.baselines.linear_servos import LinearServos, linear_response
from spelgen.fitting.servo.windows import ServoWindows

LATEST = 0.4  # s, of delays
# logarithms of frequency [rad/s] and damping ratio; delay [s]; offset [rad, m]
START = (np.log(20.0), 0.0, 0.02, 0.0)
BOUNDS = ((-np.inf, -np.inf, 0.0, -np.inf), (np.inf, np.inf, LATEST, np.inf))


def fit_linear_servos(windows: ServoWindows) -> LinearServos:
    """Fit the delay of commands to all samples of windows, and linear servos to the samples after each burn-in."""
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
            predicted = linear_response(
                q[:, 0, column], qd[:, 0, column], u, dt, np.exp(x[:1]), np.exp(x[1:2])
            )
            result: np.ndarray = (predicted - measured[..., column])[:, windows.settling :].ravel()
            return result

        fits.append(least_squares(residuals, START, bounds=BOUNDS, x_scale="jac", max_nfev=30).x)
    columns = np.array(fits).T
    columns[:2] = np.exp(columns[:2])
    frequency, damping, delay, offset = columns.tolist()
    return LinearServos(frequency, damping, delay, offset, float(late))
