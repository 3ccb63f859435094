"""Noise levels of an arm for the online estimator, and contact thresholds that are computed from the noise levels.

The noise levels are estimated from the training logs (``live.levels``) and stored in the run folder, as estimator.json.
"""

import math
from typing import Annotated

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, PlainSerializer
from scipy.special import stdtrit

from spelgen.errors import RunError
from spelgen.files import read_json, write_json
from spelgen.fitting.fitted import Fit
from spelgen.fitting.run_folder import RunFolder
from spelgen.fitting.run_record import require
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
    """Noise of the torque residual of each joint, averaged over a block of samples (see `live.filters`).

    The noise depends on the duration of a block. `NoiseLevels` therefore has a `BlockNoise` for each of its two
    durations, 0.1 and 0.2 s.

    Attributes:
        white: standard deviations of white noise, (n,) [Nm, N].
        disturbance: stationary standard deviations of a disturbance, an Ornstein-Uhlenbeck process, (n,) [Nm, N].
        time_constant: time constants of the disturbance, (n,) [s].
    """

    model_config = ConfigDict(frozen=True, arbitrary_types_allowed=True, extra="forbid")

    white: Vector
    disturbance: Vector
    time_constant: Vector


class NoiseLevels(BaseModel):
    """Noise levels and limits of an arm that the estimator uses in addition to its model.

    A peak is the largest external torque of a joint in a window of half a second, divided by its standard deviation.
    The largest fifth of the peaks of the training logs is modelled by an exponential distribution, from which the
    contact thresholds are computed.

    Attributes:
        drift: Noise of block means for the filter of friction drift and disturbance, whose blocks have 0.1 s.
        load: Noise of block means for the payload filter, whose blocks have 0.2 s.
        observer: Standard deviation of the torque residual of the momentum observer for a moving joint, (n,) [Nm, N].
        resting: Torque that is added to the contact threshold of a joint at rest, (n,) [Nm, N]: three standard
            deviations of the noise that exists at rest in addition to `observer`. At a velocity qd it is multiplied by
            exp(-|qd| / resting_speed).
        resting_speed: Velocity at which the added torque has decreased to 1/e, (n,) [rad/s, m/s].
        peak_start: Peak at which the exponential distribution begins, (n,) [1].
        peak_scale: Scale of the exponential distribution, (n,) [1].
        peak_count: Effective number of peaks from which the scale of a joint is estimated.
        load_variance: Factor by which the covariance of an estimated payload is multiplied, because the payload filter
            neglects errors of the model.
        load_freedom: Degrees of freedom of the estimate of `load_variance`.
        speed: Largest speed of the training logs, (n,) [rad/s, m/s].
        encoder: Encoder step, (n,) [rad, m].
        effort: Torque limit, (n,) [Nm, N]; for an unknown limit a multiple of the largest logged torque.
        saturation: Smallest torque that counts as saturated, divided by `effort`: 1 for a known limit, more for a
            guess, (n,) or (1,) [1].
        minutes: Duration of the training logs [min].
        point: Position of the tip in the frame of the last body, (3,) [m].
        delay: Delay of measured torques relative to positions, as found by the fit [s].
    """

    model_config = ConfigDict(frozen=True, arbitrary_types_allowed=True, extra="forbid")

    drift: BlockNoise
    load: BlockNoise
    observer: Vector
    resting: Vector
    resting_speed: Vector
    peak_start: Vector
    peak_scale: Vector
    peak_count: float
    load_variance: float
    load_freedom: float
    speed: Vector
    encoder: Vector
    effort: Vector
    minutes: float
    point: Vector
    delay: float
    saturation: Vector = np.ones(1)

    @property
    def rest_speed(self) -> np.ndarray:
        """Speed below which a joint is regarded as being at rest, (n,) [rad/s, m/s]."""
        return TUNING.rest * self.speed

    @property
    def load_quantile(self) -> float:
        """Half width of 95 % intervals of a payload, in standard deviations.

        It is a quantile of Student's t distribution, because the variance is an estimate. The quantile is multiplied by
        a factor above 1 for two reasons. First, errors are larger on other days than in the training logs. Second, a
        payload increases friction and its errors, but `load_variance` is estimated from logs without payload.
        """
        width = max(TUNING.other_days, math.sqrt(TUNING.prior_variance / self.load_variance))
        return float(stdtrit(self.load_freedom, 0.975)) * width

    @property
    def supported_alarms(self) -> float:
        """Lowest rate of false alarms that the training logs suffice for: one alarm in their total duration [1/min]."""
        return 1 / self.minutes

    def contact_thresholds(self, alarms_per_minute: float) -> np.ndarray:
        """Return the smallest external torques that are detected as contacts, in motion and at rest, (n, 2) [Nm, N].

        alarms_per_minute: rate of false alarms of all joints together [1/min].
        """
        moving = self.thresholds(alarms_per_minute) * self.observer
        return np.stack([moving, moving + self.resting], axis=1)

    def resting_torque(self, qd: np.ndarray) -> np.ndarray:
        """Return the additional contact threshold near standstill, (..., n) [Nm, N], at velocities qd, (..., n).

        It bounds the friction error near standstill. A contact threshold is the sum of this bound and a multiple of the
        standard deviation of the noise (see `thresholds`).
        """
        return np.asarray(self.resting * np.exp(-np.abs(qd) / self.resting_speed))

    @property
    def tail_peaks(self) -> float:
        """Expected number of peaks above `peak_start`, a fifth of all peaks (see the class), of all joints [1/min].

        A peak is a large torque residual in a log without contacts.
        """
        return 60 / TUNING.window * TUNING.tail * len(self.observer)

    def thresholds(self, alarms_per_minute: float) -> np.ndarray:
        """Return the contact thresholds of the external torques, divided by their standard deviations, (n,) [1].

        A peak is the largest external torque of a joint in a time window, divided by its standard deviation. Without
        contacts, all joints together have `tail_peaks` peaks per minute above `peak_start`; these peaks have an
        exponential distribution. Its scale is uncertain, because it is estimated from only m = `peak_count` peaks. With
        the prior density 1 / scale, a peak above `peak_start` also exceeds `peak_start` + x with the probability
        p(x) = (1 + x / (m `peak_scale`))^-m. The threshold is `peak_start` + x, at least 1, where x is the solution of
        `tail_peaks` p(x) = `alarms_per_minute`.

        alarms_per_minute: rate of false alarms of all joints together [1/min].
        """
        odds = self.tail_peaks / alarms_per_minute
        excess = self.peak_count * (odds ** (1 / self.peak_count) - 1)
        return np.asarray(np.maximum(self.peak_start + self.peak_scale * excess, 1.0))


def keep_levels(fit: Fit, levels: NoiseLevels) -> None:
    """Write noise levels into the run folder of a fit, if the fit has a folder."""
    if fit.folder is not None:
        write_json(RunFolder(fit.folder).estimator, levels.model_dump(mode="json"))


def stored_levels(fit: Fit) -> NoiseLevels | None:
    """Return the noise levels in the run folder of a fit; None if the fit has no folder or no stored levels."""
    file = None if fit.folder is None else RunFolder(fit.folder).estimator
    if file is None or not file.exists():
        return None
    return require(NoiseLevels, read_json(file, RunError), file)
