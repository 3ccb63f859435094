"""Hold samples of motion, thinned while logs go by, for `drive_hints`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spelgen.logs.dynamics_samples import TUNING, dynamics_samples
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.tuning.identification import DriveHintTuning

HINTS = DriveHintTuning()


class DriveSamples(NamedTuple):
    """Hold samples (S, n) of motion with the torques at the joints."""

    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    tau: np.ndarray

    def thinned(self, stride: int) -> DriveSamples:
        """Return one of so many samples."""
        return DriveSamples(*(column[::stride] for column in self))


class DriveLog:
    """Collect samples of one trajectory after another, thinned evenly to at most twice `DriveHintTuning.samples`.

    Of many trajectories only every second, fourth, ... is looked at: to filter all of a long log takes minutes.
    """

    def __init__(self, inputs: np.ndarray) -> None:
        """inputs: G, (n, n)."""
        self._inputs = inputs
        self._samples: list[DriveSamples] = []
        self._every = self._step = 1
        self._number = 0

    def add(self, trajectory: Trajectory) -> None:
        """Take in a trajectory, if it is dense and long enough for accelerations."""
        if trajectory.duration < TUNING.shortest_piece:  # most of ten thousand short motions, at no cost
            return
        self._number += 1
        if self._number % self._step:
            return
        samples = dynamics_samples([trajectory])
        if not samples:
            return
        motion = samples[0]
        tau = motion.tau @ self._inputs.T
        self._samples.append(DriveSamples(motion.q, motion.qd, motion.qdd, tau).thinned(self._every))
        while self._count > 2 * HINTS.samples:
            if len(self._samples) > HINTS.trajectories:
                self._samples = self._samples[1::2]
                self._step *= 2
            else:
                self._samples = [x.thinned(2) for x in self._samples]
                self._every *= 2

    @property
    def _count(self) -> int:
        return sum(len(x.q) for x in self._samples)

    def samples(self) -> DriveSamples | None:
        """Return all together; None where there are too few to tell anything."""
        count = self._count
        if count < HINTS.fewest_samples:
            return None
        columns = zip(*self._samples, strict=True)
        return DriveSamples(*map(np.concatenate, columns)).thinned(-(-count // HINTS.samples))
