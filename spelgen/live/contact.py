"""External torques by a first-order momentum observer (De Luca and Mattone, ICRA 2005), with thresholds per joint."""

from typing import NamedTuple

import numpy as np

from spelgen.live.momentum import Balance
from spelgen.live.noise import NoiseLevels
from spelgen.live.payload import Payload
from spelgen.live.tuning import TUNING


class ContactState(NamedTuple):
    """External torques and their thresholds, (n,) [Nm, N].

    touched: mask (n,) of torques above their thresholds. force: force at the tip in root axes, (3,) [N].
    """

    external_torque: np.ndarray
    threshold: np.ndarray
    touched: np.ndarray
    force: np.ndarray


class ContactObserver:
    """Momentum observer: a first-order low-pass filter of the terms of the momentum balance, updated with each sample.

    low: filter states, (15, n): torque, friction, uncertainty of friction, momenta of the arm at two bandwidths, and
    regressor of the payload. baseline: slow disturbance, which is subtracted from the external torque, (n,) [Nm, N].
    jerk: low-pass filtered squared change of dp/dt, (n,) [Nm^2, N^2].
    """

    def __init__(self, levels: NoiseLevels, alarms_per_minute: float) -> None:
        self.levels, self.alarms_per_minute = levels, alarms_per_minute
        self.restart()

    def restart(self) -> None:
        """Discard the filter states; the next sample initialises them."""
        self.t: float | None = None
        self.inputs = self.low = np.zeros((15, len(self.levels.speed)))
        self.touched = np.zeros(len(self.levels.speed), dtype=bool)

    def step(self, t: float, at: Balance, payload: Payload, drift: np.ndarray) -> ContactState:
        """Return the external torques after a sample.

        t: time [s]. at: terms of the momentum balance at the sample. drift: friction scale minus one, and disturbance
        [Nm, N], (n, 2).
        """
        signal, variance = self.residual(t, at, payload, drift)
        noise = np.sqrt(variance + np.square(self.levels.observer))
        threshold = self.levels.thresholds(self.alarms_per_minute) * noise
        threshold += self.levels.resting_torque(at.velocity)
        self.touched = np.abs(signal) > threshold
        force = tip_force(at.jacobian, -signal, threshold) if self.touched.any() else np.zeros(3)
        return ContactState(-signal, threshold, self.touched, force)

    def residual(
        self, t: float, at: Balance, payload: Payload, drift: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the low-pass filtered torque residual, (n,) [Nm, N], and its variance, (n,).

        The residual is the torque without the contributions of model, payload, and drift. The variance is due to
        changing accelerations, an unknown friction state and the uncertain payload. It does not include the noise of
        the observer.
        """
        rate = TUNING.bandwidth
        scale, disturbance = drift.T
        load = at.load_torque + rate * at.load_momentum
        free = at.torque - at.friction + rate * at.momentum
        inputs = np.stack([free, at.friction, at.uncertainty, at.momentum, at.momentum, *load.T])
        # A slow contact looks like a disturbance: limit the disturbance to values that occur in the training logs.
        # The excess is treated as contact.
        largest = TUNING.outlier * self.levels.drift.disturbance
        disturbance = np.clip(disturbance, -largest, largest)
        step = 0.0 if self.t is None else t - self.t
        gain = 1 - np.exp(-rate * step)
        if self.t is None:
            # Start at a torque residual of zero. The steady state of the filters for constant inputs would show an
            # external torque if the arm accelerates.
            self.low = inputs.copy()
            self.low[0], self.low[1], self.low[5:] = rate * at.momentum, 0.0, rate * at.load_momentum.T
            self.baseline, self.jerk = disturbance, np.zeros_like(disturbance)
        else:
            gains = np.full((len(inputs), 1), gain)
            # The second filter of the momenta (row 4) has twice the bandwidth of the first (row 3). The difference
            # between both estimates of dp/dt shows how fast dp/dt changes.
            gains[4] = 1 - np.exp(-2 * rate * step)
            self.low = self.low + gains * (0.5 * (inputs + self.inputs) - self.low)
            # The estimated disturbance of a joint in contact contains the contact torque: do not update the baseline.
            adapted = np.where(self.touched, 0.0, 1 - np.exp(-step / TUNING.baseline))
            self.baseline = self.baseline + adapted * (disturbance - self.baseline)
        self.t, self.inputs = t, inputs
        torque, friction, uncertainty, slow, fast = self.low[:5]
        # Filtered regressor of the payload, (n, 10). Its product with the inertial parameters of the payload is the
        # contribution of the payload to the residual.
        regressor = rate * at.load_momentum - self.low[5:].T
        signal = (
            torque - rate * at.momentum - regressor @ payload.parameters - friction * scale - self.baseline
        )
        jerk = 2 * rate * (at.momentum - fast) - rate * (at.momentum - slow)
        # Torques that lag behind the motion cause an error if dp/dt changes, and the filter of the residual retains
        # this error.
        self.jerk = self.jerk + gain * (jerk**2 - self.jerk)
        variance = TUNING.jerk**2 * (jerk**2 + self.jerk) + TUNING.uncertainty * uncertainty**2
        variance += np.einsum("ji,ik,jk->j", regressor, payload.covariance, regressor)
        return signal, variance


def tip_force(jacobian: np.ndarray, torque: np.ndarray, threshold: np.ndarray) -> np.ndarray:
    """Return the weighted least-squares estimate of a force at the tip, (3,) [N], in root axes, from external torques.

    Args:
        jacobian: Jacobian of the tip's position in root axes, (3, n).
        torque, threshold: external torques and their thresholds, (n,) [Nm, N]; weights are 1 / threshold^2.
    """
    weighted = jacobian / threshold**2
    matrix = weighted @ jacobian.T
    # With this regularization, a force component that affects no joint torque is estimated as zero.
    matrix += 1e-3 * np.trace(matrix) / 3 * np.eye(3)
    force: np.ndarray = np.linalg.solve(matrix, weighted @ torque)
    return force
