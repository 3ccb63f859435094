"""Noise levels of an arm, which are estimated from the training logs and stored in the run folder as estimator.json."""

import math
from typing import Annotated

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, PlainSerializer
from scipy.special import stdtrit

from spelgen.live.tuning import TUNING


def _vector(values: object) -> np.ndarray:
    array = np.array(values, dtype=float)
    if array.ndim != 1 or np.isnan(array).any():
        raise ValueError("a list of numbers is expected")
    return array


Vector = Annotated[
    np.ndarray, BeforeValidator(_vector), PlainSerializer(lambda x: [float(f"{v:.6g}") for v in x.tolist()])
]
"""One number per joint, (n,)."""


class BlockNoise(BaseModel):
    """Noise of the momentum balance over blocks of one length.

    white, disturbance: standard deviations of white noise and of a stationary Ornstein-Uhlenbeck process, (n,) [Nm, N].
    time_constant: time constant of the Ornstein-Uhlenbeck process, (n,) [s].
    """

    model_config = ConfigDict(frozen=True, arbitrary_types_allowed=True, extra="forbid")

    white: Vector
    disturbance: Vector
    time_constant: Vector


class NoiseLevels(BaseModel):
    """Noise levels and limits of an arm that the estimator uses in addition to its model; vectors are (n,).

    drift, load: noise of the blocks of the drift filter and of the payload filter. observer: standard deviation of the
    momentum observer for a moving joint [Nm, N]. resting: additional threshold for a joint at rest, which is three
    standard deviations of the additional noise [Nm, N] and decreases with exp(-|qd| / resting_speed). resting_speed:
    [rad/s, m/s]. peak_start, peak_scale: start and scale of the exponential tail of the peaks of the external torque
    divided by its standard deviation; the tail is the largest fifth of the peaks, of which there are peak_count per
    joint. load_variance: factor on the covariance of estimated payloads, an estimate with load_freedom degrees of
    freedom. speed: largest speed of the training logs [rad/s, m/s]. encoder: encoder step of positions [rad, m].
    effort: torque limit [Nm, N]. minutes: duration of the training logs [min]. point: position of the tip in the frame
    of the last body, (3,) [m]. delay: delay of measured torques relative to positions, found by the fit [s].
    """

    model_config = ConfigDict(frozen=True, arbitrary_types_allowed=True, extra="forbid")

    drift: BlockNoise
    load: BlockNoise
    observer: Vector
    resting: Vector
    resting_speed: Vector
    peak_start: Vector
    peak_scale: Vector
    peak_count: int
    load_variance: float
    load_freedom: float
    speed: Vector
    encoder: Vector
    effort: Vector
    minutes: float
    point: Vector
    delay: float

    @property
    def rest_speed(self) -> np.ndarray:
        """Speed below which a joint is at rest, (n,) [rad/s, m/s]."""
        return TUNING.rest * self.speed

    @property
    def load_quantile(self) -> float:
        """Half width of 95 % intervals of a payload, in standard deviations.

        It is a quantile of Student's t distribution, because the variance is estimated, times a factor. The factor
        `load_variance` is estimated from logs without payload, and the decision between payload and no payload uses
        it unchanged. Intervals are wider for two reasons: errors are larger on other days than in the training logs,
        and a payload increases friction and the errors of friction.
        """
        width = max(TUNING.other_days, math.sqrt(TUNING.prior_variance / self.load_variance))
        return float(stdtrit(self.load_freedom, 0.975)) * width

    @property
    def supported_alarms(self) -> float:
        """Lowest rate of false alarms [1/min] that the training logs support: one in their whole duration."""
        return 1 / self.minutes

    def contact_thresholds(self, alarms_per_minute: float) -> np.ndarray:
        """Return the smallest external torques that are contacts, in motion and at rest, (n, 2) [Nm, N]."""
        moving = self.thresholds(alarms_per_minute) * self.observer
        return np.stack([moving, moving + self.resting], axis=1)

    def resting_torque(self, qd: np.ndarray) -> np.ndarray:
        """Return the bound of the friction error near standstill, (..., n) [Nm, N], at velocities qd (..., n).

        The error is bounded, so it is added to the thresholds. Noise in contrast has rare peaks, so thresholds contain
        a multiple of it.
        """
        torque: np.ndarray = self.resting * np.exp(-np.abs(qd) / self.resting_speed)
        return torque

    @property
    def tail_peaks(self) -> float:
        """Number of peaks in the exponential tail per minute, for all joints together [1/min]."""
        return 60 / TUNING.window * TUNING.tail * len(self.observer)

    def thresholds(self, alarms_per_minute: float) -> np.ndarray:
        """Return the thresholds of the external torque divided by its standard deviation, (n,) [1].

        The scale of an exponential tail, estimated from m = peak_count peaks, is uncertain. With the prior 1 / scale a
        further peak exceeds the start by more than x with the probability (1 + x / (m scale))^-m.

        alarms_per_minute: rate of false alarms of all joints together [1/min].
        """
        odds = self.tail_peaks / alarms_per_minute
        excess = self.peak_count * (odds ** (1 / self.peak_count) - 1)
        thresholds: np.ndarray = np.maximum(self.peak_start + self.peak_scale * excess, 1.0)
        return thresholds
