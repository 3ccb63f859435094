"""Samples of moving joints, subsampled while the logs are read, for `drive_hints` and `torque_delay`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

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

STEPS = max(HINTS.shifts)
SHIFTS = np.array(HINTS.shifts) / FREQUENCY  # [s]


class DriveSamples(NamedTuple):
    """S samples of moving joints with their torques.

    q, qd, qdd: (S, n) [rad, m, s]. bent: (S, n, K), bristle deflection divided by the break-away displacement.
    direction: (S, n), see `DynamicsSamples`. torques: (S, n, D) [Nm, N], shifted by each of the D `SHIFTS`.
    """

    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    bent: np.ndarray
    direction: np.ndarray
    torques: np.ndarray

    @property
    def tau(self) -> np.ndarray:
        """Return the torques without shift, (S, n) [Nm, N]."""
        return self.torques[..., STEPS]

    def thinned(self, stride: int) -> DriveSamples:
        """Return every `stride`-th sample."""
        return DriveSamples(*(column[::stride] for column in self))


class DriveLog:
    """Collector of samples of successive trajectories, evenly subsampled to at most twice `DriveHintTuning.samples`.

    Of many trajectories only every second, fourth, ... is used, since filtering all of a long log takes minutes.
    """

    def __init__(self, joint_types: Sequence[str], drives: Drives, preprocessing: Preprocessing) -> None:
        """Create a collector without samples.

        Args:
            joint_types: of the n joints.
            drives: inputs and speeds of the drives.
            preprocessing: its filter and gap are used.
        """
        self._inputs, self._preprocessing = drives.inputs, replace(preprocessing, torque_delay=0.0)
        smoothing = np.full(len(joint_types), FrictionModel().coulomb_smoothing_velocity)
        self._reach = replace(reach_of(joint_types, drives.speeds), smoothing_velocity=smoothing)
        self._samples: list[DriveSamples] = []
        self._every = self._step = 1
        self._number = 0

    def add(self, trajectory: Trajectory) -> None:
        """Add the samples of a trajectory that is dense and long enough for accelerations."""
        # most of ten thousand short motions are skipped before they are filtered
        if trajectory.duration < SHORTEST:
            return
        self._number += 1
        if self._number % self._step:
            return
        for piece in long_pieces(trajectory, self._preprocessing.gap):
            # pauses included: at a constant rate a filtered torque is shifted by whole samples
            samples = dynamics_samples(
                [piece], pauses=True, preprocessing=self._preprocessing, reach=self._reach
            )
            self._samples += [self._shifted(x).thinned(self._every) for x in samples if len(x.q) > 2 * STEPS]
        while self._count > 2 * HINTS.samples:
            if len(self._samples) > HINTS.trajectories:
                self._samples = self._samples[1::2]
                self._step *= 2
            else:
                self._samples = [x.thinned(2) for x in self._samples]
                self._every *= 2

    def _shifted(self, samples: DynamicsSamples) -> DriveSamples:
        """Return the moving samples at a constant rate, without the ends, which have no shifted torques."""
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
        """Return all samples, or None if no joint moves."""
        if not self._count:
            return None
        columns = zip(*self._samples, strict=True)
        return DriveSamples(*map(np.concatenate, columns)).thinned(-(-self._count // HINTS.samples))
