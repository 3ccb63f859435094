"""Samples of an arm's motion and torques; each sample includes the signals shortly before and after its time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.interpolate import CubicSpline

from spelgen.arm.actuation import Drives
from spelgen.dynamics.bristles import reach_of
from spelgen.dynamics.friction import FrictionModel
from spelgen.identification.tuning import HINTS
from spelgen.logs.dynamics_samples import (
    FREQUENCY,
    SHORTEST,
    DynamicsSamples,
    dynamics_samples,
    is_moving,
    long_pieces,
)
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.tuning import SAMPLES

# [samples at 100 Hz] To test delays, each sample stores its signals also at these times before and after it, every
# 20 ms. Values between these times can be interpolated, because the signals are low-pass filtered.
OFFSETS = np.arange(-HINTS.longest_offset, HINTS.longest_offset + 1, 2)
# [samples] Number of samples that are omitted at each end of a recording: signals before or after it are not known.
ENDS = 3


class MotionSamples(NamedTuple):
    """S samples of motion and joint torques of n joints, with the signals around each sample.

    Attributes:
        values: (S, n, 4, E) q [rad, m], qd, qdd (per s, per s^2) and tau [Nm, N] at the E times `OFFSETS` relative to
            each sample. Before the start and after the end of a recording, the first and last values continue. E = 1 if
            a sample has only the signals at its own time, which suffice if no delays are tested.
        bent: (S, n, K) deflections of K bristles per joint, divided by the break-away displacements. They are computed
            from positions with the units, signs and zeros of the current mapping of the log. K = 0 for samples without
            a history of motion.
        direction: (S, n) direction of dry friction, see `DynamicsSamples`.
        times: (S,) times of the samples since the start of their recording [s]; unused and 0 for E = 1.
        recording: (S,) index of the recording of each sample, in the order in which recordings were added.
    """

    values: np.ndarray
    bent: np.ndarray
    direction: np.ndarray
    times: np.ndarray
    recording: np.ndarray

    @classmethod
    def of(
        cls, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, tau: np.ndarray, recording: int = 0
    ) -> MotionSamples:
        """Return samples without signals before and after each sample (E = 1, see the class), for tests without delays.

        q, qd, qdd, tau: signals at the samples, (S, n) [rad, m], per s, per s^2, and [Nm, N]. recording: index of the
        recording that contains the samples.
        """
        values = np.stack([q, qd, qdd, tau], axis=2)[..., None]
        numbers = np.full(len(q), recording)
        return cls(values, np.zeros((*q.shape, 0)), np.sign(qd), np.zeros(len(q)), numbers)

    @property
    def motion(self) -> np.ndarray:
        """Positions, velocities and accelerations at the samples, (3, S, n) [rad, m] and per s, per s^2."""
        return np.moveaxis(self.central[..., :3], 2, 0)

    @property
    def tau(self) -> np.ndarray:
        """Joint torques at the samples, (S, n) [Nm, N]."""
        return self.central[..., 3]

    @property
    def moving_joints(self) -> np.ndarray:
        """Mask (n,) of the joints that are not at rest: their velocity varies."""
        return np.asarray(self.motion[1].std(axis=0) > SAMPLES.moving)

    @property
    def central(self) -> np.ndarray:
        """Signals q, qd, qdd and tau at the times of the samples, (S, n, 4)."""
        return self.values[..., self.values.shape[3] // 2]

    def at(self, delays: np.ndarray) -> np.ndarray:
        """Return q, qd, qdd and tau (S, n, 4) at the times `delays` [s] after the samples, interpolated by a spline.

        A sample has the signals at E times around it (`values`), up to `longest_delay` before and after it. `delays` of
        shape (n, 4) are common to all samples. If they are at most `longest_delay` in magnitude, a signal is
        interpolated between the E values of its sample. Otherwise, and for `delays` of shape (S, n, 4), a signal is
        interpolated between the E values of the sample nearest to the delayed time.
        """
        if not delays.any():
            return self.central
        spline = interpolation()
        if delays.ndim == 2 and np.abs(delays).max() <= self.longest_delay:
            return np.asarray(np.einsum("snie,nie->sni", self.values, spline(delays)))
        # `present`: times of the samples on a common axis. 1e6 s are added from one recording to the next, so that the
        # nearest sample always belongs to the same recording.
        present = self.times + 1e6 * self.recording
        times = present[:, None, None] + delays
        nearest = np.searchsorted((present[1:] + present[:-1]) / 2, times)
        rest = np.clip(times - present[nearest], -self.longest_delay, self.longest_delay)
        joint, signal = np.ogrid[: delays.shape[-2], :4]
        return np.asarray(np.einsum("snie,snie->sni", self.values[nearest, joint, signal], spline(rest)))

    @property
    def longest_delay(self) -> float:
        """Longest delay [s] that can be tested with `values`, the signals at times before and after each sample.

        It is 0.16 s, the largest time in `OFFSETS`, or 0 if `values` contains only the signals at the sample's time.
        """
        return float(OFFSETS[-1]) / FREQUENCY if self.values.shape[3] > 1 else 0.0

    def part(self, rows: slice | np.ndarray) -> MotionSamples:
        """Return the subset of the samples that a slice or a mask (S,) selects."""
        return MotionSamples(*(column[rows] for column in self))

    def every(self, stride: int) -> MotionSamples:
        """Return a subset that contains every `stride`-th sample."""
        return self.part(slice(None, None, stride))

    def thinned(self, count: int) -> MotionSamples:
        """Return at most `count` samples, evenly spaced."""
        return self.every(-(-len(self.values) // count) or 1)


def joined_samples(samples: Sequence[MotionSamples]) -> MotionSamples:
    """Return the samples of several recordings as one set, in the given order."""
    return MotionSamples(*map(np.concatenate, zip(*samples, strict=True)))


@cache
def interpolation() -> CubicSpline:
    """Return a function of the time t [s] after a sample; its results are weights (E,) for cubic interpolation.

    The signal at t is the sum of the weights times the signal's values at the E times `OFFSETS` around the sample. It
    is the value of the cubic spline through these values.
    """
    return CubicSpline(OFFSETS / FREQUENCY, np.eye(len(OFFSETS)))


class DriveLog:
    """Collector of a bounded number of samples from successive trajectories, for the detection of delays and couplings.

    If the collector has more than twice `DriveHintTuning.samples` samples, half of them are removed: every second
    trajectory if it has more than `DriveHintTuning.trajectories` trajectories, otherwise every second sample. With each
    removal of trajectories, the stride of added trajectories doubles, so that only every second, fourth, ... trajectory
    is filtered and added: to filter all trajectories of a long log takes minutes.
    """

    def __init__(self, joint_types: Sequence[str], drives: Drives, preprocessing: Preprocessing) -> None:
        """Create an empty collector of samples of the motion and torques of an arm with n joints.

        Args:
            joint_types: "revolute" or "prismatic" for each of the n joints.
            drives: input matrix, which converts logged to joint torques, and matrix from joint speeds to motor speeds,
                which converts break-away displacements of the friction of motors.
            preprocessing: filter, and shortest gap [s] at which recordings are split. Its torque delay is ignored,
                since the samples are used to estimate the delay.
        """
        self._inputs, self._preprocessing = drives.inputs, replace(preprocessing, torque_delay=0.0)
        smoothing = np.full(len(joint_types), FrictionModel().coulomb_smoothing_velocity)
        self._reach = replace(reach_of(joint_types, drives.speeds), smoothing_velocity=smoothing)
        self._samples: list[MotionSamples] = []
        self._every = self._step = 1
        self._number, self._index = 0, -1

    def add(self, trajectory: Trajectory) -> None:
        """Add the samples of a trajectory; nothing is added if it is too short, or its sample rate is too low."""
        self._index += 1
        # the duration is tested before filtering, which would take too long for a log of ten thousand short motions
        if trajectory.duration < SHORTEST:
            return
        self._number += 1
        if self._number % self._step:
            return
        for piece in long_pieces(trajectory, self._preprocessing.gap):
            # Pauses are included, so that the samples are evenly spaced, and a time shift is a shift by whole samples.
            samples = dynamics_samples(
                [piece], pauses=True, preprocessing=self._preprocessing, reach=self._reach
            )
            start = float(piece.t[0] - trajectory.t[0])
            self._samples += [self._shifted(x, start) for x in samples if len(x.q) > 2 * ENDS]
        while self._count > 2 * HINTS.samples:
            if len(self._samples) > HINTS.trajectories:
                self._samples = self._samples[1::2]
                self._step *= 2
            else:
                self._thin()

    def _thin(self) -> None:
        self._samples = [x.every(2) for x in self._samples]
        self._every *= 2

    def _shifted(self, samples: DynamicsSamples, start: float) -> MotionSamples:
        """Return every k-th of the samples in motion (k = `_every`), each with its signals at the times `OFFSETS`.

        start: time from the start of the recording to the first of `samples` [s].
        """
        inner = samples[ENDS:-ENDS]
        assert inner.z is not None and inner.direction is not None
        moving = np.flatnonzero(is_moving(inner.qd))
        # before signals at E times are stored per sample: for all samples of a long log they need gigabytes
        while len(moving[:: self._every]) > 2 * HINTS.samples:
            self._thin()
        signals = np.stack([samples.q, samples.qd, samples.qdd, samples.tau @ self._inputs.T], axis=2)
        signals = np.pad(signals, ((OFFSETS[-1], OFFSETS[-1]), (0, 0), (0, 0)), mode="edge")
        around = sliding_window_view(signals, 2 * OFFSETS[-1] + 1, axis=0)[ENDS:-ENDS, ..., ::2]
        times = start + np.arange(len(samples.q)) / FREQUENCY
        bent, numbers = inner.z / self._reach.values, np.full(len(around), self._index)
        moved = MotionSamples(around, bent, inner.direction, times[ENDS:-ENDS], numbers)
        return moved.part(moving[:: self._every])

    @property
    def _count(self) -> int:
        return sum(len(x.values) for x in self._samples)

    def samples(self) -> MotionSamples | None:
        """Return the samples of all trajectories, at most `DriveHintTuning.samples`; None if there are none."""
        return joined_samples(self._samples).thinned(HINTS.samples) if self._count else None
