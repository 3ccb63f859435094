"""Samples of motion with torques moved in time, thinned while logs go by: what `drive_hints` asks its questions of."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from spelgen.identification.samples import dynamics_samples
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.values import earlier

DELAYS = np.arange(-60, 61, 10) * 1e-3  # s
MOST, LEAST = 1500, 400  # samples


class DriveSamples(NamedTuple):
    """Samples (S, n) of motion, and the torques (D, S, n) logged later by `DELAYS`."""

    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    tau: np.ndarray

    def thinned(self, every: int) -> DriveSamples:
        """Every so manieth sample."""
        q, qd, qdd, tau = self
        return DriveSamples(q[::every], qd[::every], qdd[::every], tau[:, ::every])


def drive_samples(trajectory: Trajectory, inputs: np.ndarray) -> DriveSamples | None:
    """Of one trajectory; None where it is too sparse or too short. inputs: G, (n, n)."""
    torques = [earlier(trajectory.t, trajectory.tau @ inputs.T, delay) for delay in DELAYS]
    found = dynamics_samples([replace(trajectory, tau=tau) for tau in torques])
    if not found:
        return None
    return DriveSamples(found[0].q, found[0].qd, found[0].qdd, np.stack([x.tau for x in found]))


class DriveLog:
    """Samples of one trajectory after another, thinned evenly to at most twice `MOST`."""

    def __init__(self, inputs: np.ndarray) -> None:
        self.inputs, self.parts, self.every = inputs, list[DriveSamples](), 1

    def add(self, trajectory: Trajectory) -> None:
        """Take in what a trajectory has for this."""
        found = drive_samples(trajectory, self.inputs)
        if found is None:
            return
        self.parts.append(found.thinned(self.every))
        while sum(len(x.q) for x in self.parts) > 2 * MOST:
            self.parts = [x.thinned(2) for x in self.parts]
            self.every *= 2

    def samples(self) -> DriveSamples | None:
        """All together; None: too few to tell anything."""
        if sum(len(x.q) for x in self.parts) < LEAST:
            return None
        columns = [[getattr(x, name) for x in self.parts] for name in DriveSamples._fields]
        q, qd, qdd = (np.concatenate(x) for x in columns[:3])
        whole = DriveSamples(q, qd, qdd, np.concatenate(columns[3], axis=1))
        return whole.thinned(-(-len(whole.q) // MOST))
