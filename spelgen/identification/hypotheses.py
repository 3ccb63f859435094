"""Hypotheses about a log: joint, scale, zero and delay of its columns, and the direction of gravity."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from spelgen.arm.arm import Chain
from spelgen.identification.motion_samples import MotionSamples

if TYPE_CHECKING:
    from spelgen.identification.log_faults import Fault

Vector3 = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Hypothesis about a log: columns, scales, offsets and delays of n joints, and gravity.

    Arrays of shape (2, n) have a row for the motion (position and velocity) and a row for the torque of each joint. The
    position of joint k is scale[0, k] times the logged position of joint source[0, k], plus offset[k]. The torque of
    joint k is scale[1, k] times the logged torque of joint source[1, k].

    Attributes:
        faults: kinds of faults that the hypothesis assumes; empty for the unchanged log.
        source: (2, n) indices of the joints under which the signals are logged.
        scale: (2, n) factors from logged signals to SI units.
        offset: (n,) zero offsets of the positions [rad, m].
        delay: (2, n) delays of the logged signals [s], at the start of a recording if they drift.
        drift: (2, n) derivatives of the delays with respect to time [1].
        gravity: vector of gravity in the frame of the root link [m/s^2].
    """

    faults: tuple[Fault, ...]
    source: np.ndarray
    scale: np.ndarray
    offset: np.ndarray
    delay: np.ndarray
    drift: np.ndarray
    gravity: Vector3

    @classmethod
    def unchanged(cls, arm: Chain) -> Hypothesis:
        """Return the hypothesis that a log in SI units has no faults: no exchanged columns, offsets or delays."""
        n = len(arm.coordinates)
        x, y, z = map(float, arm.gravity)
        order, zeros = np.tile(np.arange(n), (2, 1)), np.zeros((2, n))
        return cls((), order, np.ones((2, n)), np.zeros(n), zeros, zeros, (x, y, z))

    @property
    def motion_key(self) -> tuple[bytes, Vector3]:
        """Key under which the regressor of the hypothesis is cached, since it depends only on motion and gravity."""
        arrays = (self.source[0], self.scale[0], self.offset, self.delay[0], self.drift[0])
        return b"".join(x.tobytes() for x in arrays), self.gravity

    def changed(self, fault: Fault, **changes: object) -> Hypothesis:
        """Return the hypothesis with changed fields that correct one more kind of fault, `fault`."""
        faults = self.faults if fault in self.faults else (*self.faults, fault)
        return replace(self, faults=faults, **changes)  # type: ignore[arg-type]

    def signals(self, samples: MotionSamples) -> MotionSamples:
        """Return the samples corrected by this hypothesis: true signals of the joints, in SI units.

        samples: logged samples. The result has signals only at the samples, and not at times before and after each
        sample: the last axis of `values` has the length 1.
        """
        delays = _per_signal(self.delay)
        if self.drift.any():
            delays = delays + samples.times[:, None, None] * _per_signal(self.drift)
        values = samples.values if delays.any() else samples.central[..., None]
        signals = samples._replace(values=_permuted(values, self.source)).at(delays) * _per_signal(self.scale)
        signals[..., 0] += self.offset
        return samples._replace(values=signals[..., None])

    def logged(self, samples: MotionSamples) -> MotionSamples:
        """Return the samples that a log with these faults has for the true signals `samples` (inverse of `signals`).

        The hypothesis must have no delays, and no exchanged columns.
        """
        signals = samples.values.copy()
        signals[:, :, 0] -= self.offset[:, None]
        return samples._replace(values=signals / _per_signal(self.scale)[..., None])


def _per_signal(values: np.ndarray) -> np.ndarray:
    """Return values for the signals q, qd, qdd and tau, (n, 4), from values for motion and torque, (2, n)."""
    return values[[0, 0, 0, 1]].T


def _permuted(values: np.ndarray, source: np.ndarray) -> np.ndarray:
    """Return signals (S, n, 4, E), with the motion of joint source[0, k] and the torque of joint source[1, k] at k.

    values: (S, n, 4, E), see `MotionSamples`. Without a permutation, the result is `values` itself: a copy would take a
    twentieth of the time of a search.
    """
    if (source == np.arange(source.shape[1])).all():
        return values
    return np.concatenate([values[:, source[0], :3], values[:, source[1], 3:]], axis=2)


@dataclass(frozen=True, eq=False)
class HypothesisFit:
    """MAP estimate of the K parameters of an arm with n joints under a hypothesis about the log.

    Attributes:
        hypothesis: the hypothesis.
        cost: negative log posterior up to a constant.
        misfit: contribution of the torque residual to the cost.
        parameters: (K,) inertial parameters, then friction and rotor inertias.
        covariance: (K, K) posterior covariance of the parameters.
        errors: (n,) mean squared residual of each joint's torque, divided by the variance of the torque.
    """

    hypothesis: Hypothesis
    cost: float
    misfit: float
    parameters: np.ndarray
    covariance: np.ndarray
    errors: np.ndarray

    @property
    def rank(self) -> float:
        """Cost plus penalties for rare faults; the hypothesis of lowest rank is preferred."""
        return self.cost + sum(fault.rarity for fault in self.hypothesis.faults)
