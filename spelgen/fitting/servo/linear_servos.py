"""Fit of the baselines of arms under position servos: the delayed command, and linear second-order servos."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.optimize import least_squares, minimize_scalar

from spelgen.baselines.linear_servos import LinearServos, linear_response
from spelgen.fitting.servo.tuning import LinearServoTuning
from spelgen.fitting.servo.windows import ServoWindows

TUNING = LinearServoTuning()


def fit_linear_servos(windows: ServoWindows) -> LinearServos:
    """Fit the delay of the commands to all samples of windows, and a linear servo per joint to those after burn-in."""
    q, qd = windows.q.numpy(), windows.qd.numpy()
    measured, dt = q[:, 1:], float(windows.dt.mean())

    # finite differences change one of four unknowns at a time, three of which are not the delay
    @lru_cache(maxsize=8)
    def commands(delay: float) -> np.ndarray:
        """Return the mean command of each interval, (W, K-1, n)."""
        return windows.commands(delay).mean(dim=2).numpy()

    def delayed_error(delay: float) -> float:
        return float(np.square(commands(delay) - measured).mean())

    # commands change little within the bounds, so the error has one minimum
    late = minimize_scalar(delayed_error, bounds=(0, TUNING.max_delay), method="bounded").x
    # logarithms of natural frequency and damping ratio, delay, offset
    initial = (np.log(TUNING.frequency), 0.0, TUNING.delay, 0.0)
    bounds = ((-np.inf, -np.inf, 0.0, -np.inf), (np.inf, np.inf, TUNING.max_delay, np.inf))
    fits = []
    for joint in range(q.shape[2]):
        column = slice(joint, joint + 1)

        def residual(x: np.ndarray, column: slice = column) -> np.ndarray:
            """Return the position errors after the burn-in, (M,)."""
            u = commands(x[2])[..., column] + x[3]
            predicted = linear_response(
                q[:, 0, column], qd[:, 0, column], u, dt, np.exp(x[:1]), np.exp(x[1:2])
            )
            result: np.ndarray = (predicted - measured[..., column])[:, windows.burn_in :].ravel()
            return result

        fits.append(least_squares(residual, initial, bounds=bounds, x_scale="jac", max_nfev=30).x)
    columns = np.array(fits).T
    columns[:2] = np.exp(columns[:2])
    frequency, damping, delay, offset = columns.tolist()
    return LinearServos(frequency, damping, delay, offset, float(late))
