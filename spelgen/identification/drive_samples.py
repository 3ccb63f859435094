"""Hold samples of motion, thinned while logs go by, for `drive_hints` and `torque_delay`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from spelgen.arm.actuation import Drives
from spelgen.dynamics.bristles import reach_of
from spelgen.dynamics.linear_friction import FrictionModel
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

STEPS = max(HINTS.shifts)
SHIFTS = np.array(HINTS.shifts) / FREQUENCY  # [s]


class DriveSamples(NamedTuple):
    """Hold S samples of motion with the torques at n joints.

    q, qd, qdd: (S, n). bent: (S, n, K), of bristles, by their reach. direction: see `DynamicsSamples`.
    torques: (S, n, D), moved by each of the D `SHIFTS`.
    """

    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    bent: np.ndarray
    direction: np.ndarray
    torques: np.ndarray

    @property
    def tau(self) -> np.ndarray:
        """Return torques as logged, (S, n)."""
        return self.torques[..., STEPS]

    def thinned(self, stride: int) -> DriveSamples:
        """Return one of so many samples."""
        return DriveSamples(*(column[::stride] for column in self))


class DriveLog:
    """Collect samples of one trajectory after another, thinned evenly to at most twice `DriveHintTuning.samples`.

    Of many trajectories only every second, fourth, ... is looked at: to filter all of a long log takes minutes.
    """

    def __init__(self, kinds: Sequence[str], drives: Drives, preprocessing: Preprocessing) -> None:
        """Begin without samples. kinds: the joints' types. preprocessing: its filter and gap are used."""
        self._inputs, self._preprocessing = drives.inputs, replace(preprocessing, torque_delay=0.0)
        smoothing = np.full(len(kinds), FrictionModel().coulomb_smoothing_velocity)
        self._reach = replace(reach_of(kinds, drives.speeds), smoothing_velocity=smoothing)
        self._samples: list[DriveSamples] = []
        self._every = self._step = 1
        self._number = 0

    def add(self, trajectory: Trajectory) -> None:
        """Take in a trajectory, if it is dense and long enough for accelerations."""
        if trajectory.duration < SHORTEST:  # most of ten thousand short motions, at no cost
            return
        self._number += 1
        if self._number % self._step:
            return
        for piece in long_pieces(trajectory, self._preprocessing.gap):
            # without a hole and pauses included, a filtered torque is moved by whole samples
            samples = dynamics_samples(
                [piece], pauses=True, preprocessing=self._preprocessing, reach=self._reach
            )
            self._samples += [self._moved(x).thinned(self._every) for x in samples if len(x.q) > 2 * STEPS]
        while self._count > 2 * HINTS.samples:
            if len(self._samples) > HINTS.trajectories:
                self._samples = self._samples[1::2]
                self._step *= 2
            else:
                self._samples = [x.thinned(2) for x in self._samples]
                self._every *= 2

    def _moved(self, samples: DynamicsSamples) -> DriveSamples:
        """Return what moves of samples at a steady rate, but for the ends that torques are moved from."""
        inner = samples[STEPS:-STEPS]
        assert inner.z is not None and inner.direction is not None
        torques = sliding_window_view(samples.tau @ self._inputs.T, len(SHIFTS), axis=0)
        columns = (inner.q, inner.qd, inner.qdd, inner.z / self._reach.values, inner.direction, torques)
        moving = is_moving(inner.qd)
        return DriveSamples(*(column[moving] for column in columns))

    @property
    def _count(self) -> int:
        return sum(len(x.q) for x in self._samples)

    def samples(self) -> DriveSamples | None:
        """Return all together; None where nothing moves."""
        if not self._count:
            return None
        columns = zip(*self._samples, strict=True)
        return DriveSamples(*map(np.concatenate, columns)).thinned(-(-self._count // HINTS.samples))
