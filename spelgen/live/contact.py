"""External torques by a first-order momentum observer (De Luca and Mattone, ICRA 2005), with thresholds per joint."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spelgen.live.momentum import Balance
from spelgen.live.noise import NoiseLevels
from spelgen.live.payload import Payload
from spelgen.live.tuning import TUNING


class ContactState(NamedTuple):
    """External torques and thresholds, (n,) [Nm, N]; touched: mask (n,) of torques above; force: at the tip [N]."""

    external_torque: np.ndarray
    threshold: np.ndarray
    touched: np.ndarray
    force: np.ndarray


class ContactObserver:
    """First-order low-pass filter of the momentum balance, updated with each sample.

    Each low-passed term is a state, (15, n): torque, friction, its uncertainty, the momenta of the arm at two
    bandwidths, and the regressor of the payload.
    """

    def __init__(self, levels: NoiseLevels, alarms_per_minute: float) -> None:
        self.levels, self.factor = levels, levels.thresholds(alarms_per_minute)
        self.restart()

    def restart(self) -> None:
        """Discard the filter states; the next sample initialises them."""
        self.t: float | None = None
        self.inputs = self.low = np.zeros((15, len(self.factor)))

    def step(
        self, t: float, qd: np.ndarray, at: Balance, payload: Payload, scale: np.ndarray
    ) -> ContactState:
        """Return the external torques after a sample. at: its terms; scale: friction scale minus one, (n,)."""
        signal, variance = self.residual(t, qd, at, payload, scale)
        threshold = self.factor * np.sqrt(variance)
        touched = np.abs(signal) > threshold
        force = tip_force(at.jacobian, -signal, variance) if touched.any() else np.zeros(3)
        return ContactState(-signal, threshold, touched, force)

    def residual(
        self, t: float, qd: np.ndarray, at: Balance, payload: Payload, scale: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the low-pass filtered torque residual of model, payload and drift, and its variance, (n,) each."""
        rate = TUNING.bandwidth
        load = at.load_torque + rate * at.load_momentum
        free = at.torque - at.friction + rate * at.momentum
        inputs = np.stack([free, at.friction, at.uncertainty, at.momentum, at.momentum, *load.T])
        if self.t is None:
            # the steady state for constant inputs
            self.low = inputs
        else:
            gains = np.full((len(inputs), 1), 1 - np.exp(-rate * (t - self.t)))
            # twice the bandwidth: the difference of two estimates of dp/dt is proportional to its rate
            gains[4] = 1 - np.exp(-2 * rate * (t - self.t))
            self.low = self.low + gains * (0.5 * (inputs + self.inputs) - self.low)
        self.t, self.inputs = t, inputs
        torque, friction, uncertainty, slow, fast = self.low[:5]
        # regressor Phi of the payload, (n, 10), as in `Block`
        regressor = rate * at.load_momentum - self.low[5:].T
        signal = torque - rate * at.momentum - regressor @ payload.parameters - friction * scale
        jerk = 2 * rate * (at.momentum - fast) - rate * (at.momentum - slow)
        resting = TUNING.resting_friction * self.levels.coulomb * np.exp(-np.abs(qd) / self.levels.rest_speed)
        variance = self.levels.observer**2 + resting**2 + jerk**2 + TUNING.uncertainty * uncertainty**2
        variance += np.einsum("ji,ik,jk->j", regressor, payload.covariance, regressor)
        return signal, variance


def tip_force(jacobian: np.ndarray, torque: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Return the weighted least-squares estimate of a force at the tip, (3,) [N], in root axes, from external torques.

    Args:
        jacobian: of the tip, (3, n).
        torque, variance: external torques [Nm, N] and their variances, (n,).
    """
    weighted = jacobian / variance
    matrix = weighted @ jacobian.T
    # a force that no joint torque depends on is zero
    matrix += 1e-3 * np.trace(matrix) / 3 * np.eye(3)
    force: np.ndarray = np.linalg.solve(matrix, weighted @ torque)
    return force
