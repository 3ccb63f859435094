"""Errors that real arms and their sensors have, at random levels, for the simulated arms of `truth.py`.

Levels are chosen so that torque residuals resemble residuals of recordings, see `residual_statistics.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

RIPPLE_PERIODS = (
    1,
    2,
    12,
    30,
    60,
    100,
    160,
)  # periods of torque ripple per revolution of a joint: eccentric bearings, gear teeth, motors
# [rad, m] The hysteresis torque of a cable at a joint saturates after a displacement. Bounds of its random values.
CABLE_BREAKAWAY = (0.05, 0.5)
CURRENT_CORRELATION = 0.01  # [s] correlation time of the noise of the motor current
BACKLASH_TORQUE = (
    0.05  # [1] torque at which gears change the tooth flank, relative to the torque's standard deviation
)


@dataclass(frozen=True)
class RealErrors:
    """Levels of the errors of an arm and its sensors; by default all errors are absent."""

    friction_position: float = 0.0  # [1] largest relative change of dry friction with position
    warm_up: float = 0.0  # [1] relative decrease of friction during a recording
    warm_up_time: float = np.inf  # [s] time constant of the decrease of friction
    friction_drift: float = 0.0  # [1] relative standard deviation of friction between recordings
    cable: float = 0.0  # [1] hysteresis of cables, relative to nominal dry friction
    ripple: float = 0.0  # [1] torque ripple of gears, relative to nominal dry friction
    resonance: float = np.inf  # [Hz] natural frequency of a link on its elastic joint
    backlash: float = 0.0  # [rad, m] play of the gears between both tooth flanks
    encoder_step: float = 0.0  # [rad, m] resolution of positions
    sensor_cutoff: float = np.inf  # [Hz] cutoff of the first-order low-pass of the torque signal
    current_noise: float = 0.0  # [1] noise of the motor current, relative to the torque's standard deviation
    # [1] torque noise with the correlation time `slow_correlation`, relative to the torque's standard deviation
    slow_noise: float = 0.0
    slow_correlation: float = 0.0  # [s] correlation time of `slow_noise`
    gain: float = 0.0  # [1] standard deviation of log(logged torque / true torque), one factor per joint
    zero: float = 0.0  # [rad, m] standard deviation of the zero offset of logged positions, per joint


def draw_errors(rng: np.random.Generator) -> RealErrors:
    """Draw the errors of an arm: each is present with its own probability, and its level is log-uniform."""

    def level(probability: float, low: float, high: float, absent: float = 0.0) -> float:
        present, value = rng.random() < probability, float(np.exp(rng.uniform(*np.log([low, high]))))
        return value if present else absent

    return RealErrors(
        friction_position=level(0.9, 0.1, 0.5),
        warm_up=level(0.6, 0.03, 0.3),
        warm_up_time=level(1.0, 10.0, 300.0),
        friction_drift=level(0.6, 0.01, 0.06),
        cable=level(0.8, 0.2, 1.0),
        ripple=level(0.95, 0.3, 1.5),
        resonance=level(0.6, 10.0, 40.0, np.inf),
        backlash=level(0.4, 1e-4, 2e-3),
        encoder_step=2 * np.pi / 2 ** int(rng.integers(12, 19)),
        sensor_cutoff=level(0.4, 15.0, 60.0, np.inf),
        current_noise=level(0.95, 0.03, 0.15),
        slow_noise=level(0.95, 0.03, 0.15),
        slow_correlation=level(1.0, 0.2, 3.0),
        gain=level(0.4, 0.005, 0.03),
        zero=level(0.5, 5e-4, 5e-3),
    )


class ErrorProcess:
    """Errors of a simulated arm with n joints, from their levels and random phases, periods and factors per joint.

    gain: (n,) factors from true to logged torques [1]. zero: (n,) zero offsets of logged positions [rad, m]. cable:
    (n,) magnitude of the hysteretic friction of cables [Nm, N].
    """

    def __init__(self, errors: RealErrors, dry: np.ndarray, rng: np.random.Generator) -> None:
        """Draw the phases, periods and factors of the errors per joint; dry: (n,) nominal dry friction [Nm, N]."""
        n = len(dry)
        self.errors = errors
        self.gain = np.exp(errors.gain * rng.normal(size=n))
        self.zero = errors.zero * rng.normal(size=n)
        self._phase, self._second_phase, self._ripple_phase = rng.uniform(0, 2 * np.pi, (3, n))
        self._waves = rng.integers(1, 6, n)
        self._periods = rng.choice(RIPPLE_PERIODS, n)
        self._ripple = errors.ripple * dry * rng.uniform(0.3, 1.0, n)
        self.cable = errors.cable * dry * rng.uniform(0.3, 1.0, n)
        self._breakaway = np.exp(rng.uniform(*np.log(CABLE_BREAKAWAY), n))

    def friction_factor(self, q: np.ndarray) -> np.ndarray:
        """Return the factor on dry friction, (T, n), at positions q (T, n) [rad, m]: one plus waves along the range."""
        wave = 0.6 * np.sin(q + self._phase) + 0.4 * np.sin(self._waves * q + self._second_phase)
        return 1 + self.errors.friction_position * wave

    def temperature_factor(self, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return the factor on friction, (T, n), at times t (T,) [s] of a recording: warm-up and a random drift."""
        drift = np.exp(self.errors.friction_drift * rng.normal(size=len(self.gain)))
        warm = np.exp(-t / self.errors.warm_up_time)
        return (1 + self.errors.warm_up * (warm - warm.mean()))[:, None] * drift

    def ripple(self, q: np.ndarray) -> np.ndarray:
        """Return the torque ripple of the gears, (T, n) [Nm, N], at positions q (T, n) [rad, m]."""
        return np.asarray(self._ripple * np.sin(self._periods * q + self._ripple_phase))

    def hysteresis(self, q: np.ndarray) -> np.ndarray:
        """Return the hysteretic friction of cables, (T, n) [Nm, N], along positions q (T, n) [rad, m].

        Far from the last reversal its magnitude is the attribute `cable`.
        """
        return self.cable * play(q, self._breakaway) if self.cable.any() else np.zeros_like(q)

    def deflection(self, torque: np.ndarray, inertia: np.ndarray) -> np.ndarray:
        """Return the motor position minus the link position, (T, n) [rad, m].

        Args:
            torque: (T, n) [Nm, N] that deflects the elastic joint.
            inertia: (n,) [kg m^2, kg] of the link. The stiffness of the joint is inertia (2 pi resonance)^2.
        """
        twist = torque / (inertia * (2 * np.pi * self.errors.resonance) ** 2)
        if self.errors.backlash:
            flank = np.tanh(torque / (BACKLASH_TORQUE * torque.std(axis=0) + 1e-12))
            twist = twist + 0.5 * self.errors.backlash * flank
        return twist

    def sensed(self, torque: np.ndarray, rate: float, rng: np.random.Generator) -> np.ndarray:
        """Return the sensor's signal of a torque, both (T, n) [Nm, N]: low-passed, with correlated noise.

        rate: sample rate [Hz].
        """
        errors, seen = self.errors, torque
        if np.isfinite(errors.sensor_cutoff):
            keep = np.exp(-2 * np.pi * errors.sensor_cutoff / rate)
            seen = lfilter([1 - keep], [1, -keep], seen, axis=0, zi=keep * seen[:1])[0]
        noises = (errors.current_noise, CURRENT_CORRELATION), (errors.slow_noise, errors.slow_correlation)
        for level, time in noises:
            if level:
                deviation = level * torque.std(axis=0)
                seen = seen + deviation * _correlated_noise(torque.shape, rate * time, rng)
        return seen

    def encoded(self, q: np.ndarray) -> np.ndarray:
        """Return positions (T, n) [rad, m] rounded to steps of the encoder."""
        step = self.errors.encoder_step
        return q if not step else step * np.round(q / step)


def _correlated_noise(shape: tuple[int, ...], time: float, rng: np.random.Generator) -> np.ndarray:
    """Return stationary noise (T, n) of variance one, with autocorrelation exp(-lag / time); time: in samples."""
    keep = np.exp(-1 / time)
    first = keep * rng.normal(size=(1, shape[1]))
    white = np.sqrt(1 - keep**2) * rng.normal(size=shape)
    return np.asarray(lfilter([1.0], [1.0, -keep], white, axis=0, zi=first)[0])


def play(q: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Return the state of Maxwell-slip elements (a spring and a slider) per joint along positions, (T, n), in -1..1.

    The initial state is zero.

    Args:
        q: (T, n) positions [rad, m].
        reach: (n,) break-away displacement [rad, m]; or (K, n) of K elements, for the mean of their states.
    """
    reaches = np.atleast_2d(reach)
    z = np.zeros_like(reaches)
    states = np.zeros_like(q)
    for k in range(1, len(q)):
        z = np.clip(z + (q[k] - q[k - 1]), -reaches, reaches)
        states[k] = (z / reaches).mean(axis=0)
    return states
