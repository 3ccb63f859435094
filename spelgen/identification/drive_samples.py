"""Hold samples of motion, thinned while logs go by, for `drive_hints`."""

from __future__ import annotations

import numpy as np

from spelgen.logs.dynamics_samples import TUNING, dynamics_samples
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.tuning.identification import DriveHintTuning

HINTS = DriveHintTuning()


class DriveLog:
    """Collect samples of one trajectory after another, thinned evenly to at most twice `DriveHintTuning.samples`.

    Of many trajectories only every second, fourth, ... is looked at: to filter all of a long log takes minutes.
    """

    def __init__(self, inputs: np.ndarray) -> None:
        """inputs: G, (n, n)."""
        self._inputs = inputs
        self._motions: list[np.ndarray] = []  # (4, T, n)
        self._every = self._step = 1
        self._number = 0

    def add(self, trajectory: Trajectory) -> None:
        """Take in a trajectory, if it is dense and long enough for accelerations."""
        if trajectory.duration < TUNING.shortest_piece:  # most of ten thousand short motions, at no cost
            return
        self._number += 1
        if self._number % self._step:
            return
        for x in dynamics_samples([trajectory]):
            motion = np.stack([x.q, x.qd, x.qdd, x.tau @ self._inputs.T])
            self._motions.append(motion[:, :: self._every])
        while self._count > 2 * HINTS.samples:
            if len(self._motions) > HINTS.trajectories:
                self._motions = self._motions[1::2]
                self._step *= 2
            else:
                self._motions = [x[:, ::2] for x in self._motions]
                self._every *= 2

    @property
    def _count(self) -> int:
        return sum(x.shape[1] for x in self._motions)

    def motion(self) -> np.ndarray | None:
        """Return q, qd, qdd and joint torques of all, (4, S, n); None where there are too few to tell anything."""
        if self._count < HINTS.fewest_samples:
            return None
        return np.concatenate(self._motions, axis=1)[:, :: -(-self._count // HINTS.samples)]
