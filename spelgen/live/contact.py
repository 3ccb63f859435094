"""External torques by a first-order momentum observer (De Luca and Mattone, ICRA 2005), and detection of contacts."""

import math
from typing import NamedTuple

import numpy as np

from spelgen.live.momentum import Balance
from spelgen.live.noise import NoiseLevels
from spelgen.live.payload import Payload
from spelgen.live.tuning import TUNING


class ContactState(NamedTuple):
    """External torques of a sample, and the detected contact.

    Attributes:
        external_torque: estimated torques of contacts at the joints, (n,) [Nm, N].
        threshold: magnitudes above which external torques are contacts, (n,) [Nm, N].
        touched: True for joints whose external torque exceeds the threshold, (n,).
        force: estimated contact force at the tip in root axes, (3,) [N]; zero without a contact.
    """

    external_torque: np.ndarray
    threshold: np.ndarray
    touched: np.ndarray
    force: np.ndarray


class ContactObserver:
    """Momentum observer of external torques: first-order low-pass filters of the terms of the momentum balance.

    The filters are updated with each sample.

    Args:
        levels: noise levels of the arm, from which the thresholds are computed.
        alarms_per_minute: rate of false contact alarms [1/min].

    Attributes:
        low: Low-pass filtered terms, (15, n). Row 0: torque; 1: friction; 2: uncertainty of friction; 3 and 4: momentum
            p of the arm; 5 to 14: regressor of the payload. Row 4 is filtered at twice the bandwidth of the observer,
            all other rows at this bandwidth.
        baseline: Low-pass filtered disturbance d of the drift filter, which is subtracted from the external torque,
            (n,) [Nm, N].
        jerk: Low-pass filtered square of the difference between the estimates of dp/dt from rows 3 and 4, a measure of
            the change of dp/dt, (n,) [Nm^2, N^2].
        level: Mean of the squared `normalised` torque residual (see below, but without division by the level) over
            about the last half second, (n,) [1]. The contact threshold is multiplied by sqrt(level) if the level is
            above 1: residuals are larger in some motions, for example if the arm vibrates. The level contains no
            samples of the last two blocks (see `Block`), so that a contact does not raise the threshold before it is
            detected. The squares are limited to `TUNING.level_limit` = 4, so that slow contacts raise the threshold by
            a factor of at most two.
        normalised: Excess of the external torque's magnitude over `NoiseLevels.resting_torque`, divided by the standard
            deviation of the torque residual and by sqrt(level), (n,) [1]. A joint is in contact above
            `NoiseLevels.thresholds`.
    """

    def __init__(self, levels: NoiseLevels, alarms_per_minute: float) -> None:
        self.levels, self.alarms_per_minute = levels, alarms_per_minute
        self.restart()

    def restart(self) -> None:
        """Discard the filter states, for example after a gap; the next sample initialises the filters."""
        self.t: float | None = None
        self.inputs = self.low = np.zeros((15, len(self.levels.speed)))
        self.baseline = np.zeros_like(self.levels.speed)
        self.level = self.recent = np.ones_like(self.baseline)
        self.touched = np.zeros(len(self.baseline), dtype=bool)
        self.squares, self.count = np.zeros_like(self.baseline), 0

    def step(self, t: float, at: Balance, payload: Payload, drift: np.ndarray) -> ContactState:
        """Update the observer with a sample; return the external torques and the detected contact.

        Args:
            t: Time of the sample [s].
            at: Terms of the momentum balance at the sample.
            payload: Estimated payload.
            drift: Estimates of the drift filter, (n, 2): friction scale minus one [1], and disturbance [Nm, N].
        """
        signal, variance = self.residual(t, at, payload, drift)
        noise = np.sqrt(variance + np.square(self.levels.observer))
        resting = self.levels.resting_torque(at.velocity)
        factor = np.sqrt(np.maximum(self.level, 1.0))
        threshold = self.levels.thresholds(self.alarms_per_minute) * factor * noise + resting
        self.touched = np.abs(signal) > threshold
        normalised = np.maximum(np.abs(signal) - resting, 0.0) / noise
        self.normalised = normalised / factor
        # For a joint in contact the present level is added instead of the squared residual, which is not noise then.
        limited = np.minimum(np.square(normalised), TUNING.level_limit)
        self.squares = self.squares + np.where(self.touched, self.level, limited)
        self.count += 1
        force = tip_force(at.jacobian, -signal, threshold) if self.touched.any() else np.zeros(3)
        return ContactState(-signal, threshold, self.touched, force)

    def end_block(self) -> None:
        """Update the attribute `level` (mean square of the residual) at the end of a block of samples."""
        self.level = self.level + (1 - math.exp(-TUNING.block / TUNING.level)) * (self.recent - self.level)
        self.recent = self.squares / self.count
        self.squares, self.count = np.zeros_like(self.squares), 0

    def residual(
        self, t: float, at: Balance, payload: Payload, drift: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Update the filters with a sample; return the torque residual, (n,) [Nm, N], and its variance, (n,).

        The residual is the low-pass filtered difference between the measured torque and the sum of the torques of
        model, payload and drift. It estimates the external torque with a reversed sign. The variance has three terms:
        for changing accelerations, for an unknown friction state and for the uncertain payload. It does not contain
        the noise variance of the observer, which `step` adds.

        t, at, payload, drift: see `step`.
        """
        rate = TUNING.bandwidth
        scale, disturbance = drift.T
        load = at.load_torque + rate * at.load_momentum
        free = at.torque - at.friction + rate * at.momentum
        inputs = np.stack([free, at.friction, at.uncertainty, at.momentum, at.momentum, *load.T])
        # The drift filter cannot distinguish a slow contact from a disturbance. The disturbance is limited to values
        # that occur in the training logs, and the excess is treated as contact.
        largest = TUNING.outlier * self.levels.drift.disturbance
        disturbance = np.clip(disturbance, -largest, largest)
        step = 0.0 if self.t is None else t - self.t
        gain = 1 - np.exp(-rate * step)
        if self.t is None:
            # The initial filter states give a torque residual of zero. With the steady state for constant inputs as
            # initial states, the residual of an accelerating arm would not be zero.
            self.low = inputs.copy()
            self.low[0], self.low[1], self.low[5:] = rate * at.momentum, 0.0, rate * at.load_momentum.T
            self.baseline, self.jerk = disturbance, np.zeros_like(disturbance)
        else:
            gains = np.full((len(inputs), 1), gain)
            # Rows 3 and 4 of `low` are the momentum p after low-pass filters with the bandwidths `rate` and 2 `rate`.
            # Each gives an estimate of dp/dt; the difference of the two indicates how fast dp/dt changes.
            gains[4] = 1 - np.exp(-2 * rate * step)
            self.low = self.low + gains * (0.5 * (inputs + self.inputs) - self.low)
            # The baseline (slow disturbance) of a joint in contact is not updated, because the estimated disturbance
            # then contains the contact torque.
            adapted = np.where(self.touched, 0.0, 1 - np.exp(-step / TUNING.baseline))
            self.baseline = self.baseline + adapted * (disturbance - self.baseline)
        self.t, self.inputs = t, inputs
        torque, friction, uncertainty, slow, fast = self.low[:5]
        # `regressor` is the filtered regressor of the payload, (n, 10). Its product with the inertial parameters of the
        # payload is the torque of the payload in the residual.
        regressor = rate * at.load_momentum - self.low[5:].T
        signal = (
            torque - rate * at.momentum - regressor @ payload.parameters - friction * scale - self.baseline
        )
        jerk = 2 * rate * (at.momentum - fast) - rate * (at.momentum - slow)
        # `jerk` [Nm, N] is the difference of two estimates of dp/dt, with the momentum p (see `TUNING.jerk`). If
        # measured torques lag behind the motion, the residual has an error proportional to it. The low-pass filter of
        # the observer prolongs this error by about its time constant. The variance therefore contains jerk^2 for the
        # present error, and `self.jerk`, the low-pass filtered jerk^2, for past errors.
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
    # With the regularization of `matrix`, a force component that affects no joint torque is estimated as zero, also if
    # no component does: the tip is on the axis of an arm of one joint.
    matrix += (1e-3 * np.trace(matrix) / 3 + np.finfo(float).tiny) * np.eye(3)
    return np.linalg.solve(matrix, weighted @ torque)
