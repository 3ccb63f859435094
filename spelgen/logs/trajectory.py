"""What every step of the way from log files to training windows works on."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

QUANTITIES = ("q", "qd", "tau")
GAP = 4.0  # a step longer than this many median steps is a hole in the recording, not jitter


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One uninterrupted recording of an arm with n joints.

    name: unique among the trajectories read together.
    t: (T,) sample times [s], strictly increasing, not necessarily regular.
    q, qd: (T, n) joint positions and velocities [rad, rad/s; m, m/s for prismatic joints].
    tau: (T, n) joint torques or forces [Nm; N]. In a simulated log tau[k] is held from t[k] to t[k+1]; in a
        measured one it is the torque measured at t[k].
    file: where it was read from, None if it was not.
    declares_units: the file itself, or the mapping it was read by, says in what units its columns are.
    """

    name: str
    t: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    tau: np.ndarray
    file: Path | None = None
    declares_units: bool = False

    def __post_init__(self) -> None:
        samples = self.t.shape[0] if self.t.ndim == 1 else -1
        for name in QUANTITIES:
            array = getattr(self, name)
            if array.ndim != 2 or array.shape[0] != samples or array.shape != self.q.shape:
                raise ValueError(
                    f"trajectory {self.name}: {name} has shape {array.shape} beside t of shape {self.t.shape}"
                )

    def __getitem__(self, rows: slice) -> Trajectory:
        """The same recording, only these rows."""
        cut = {name: getattr(self, name)[rows] for name in ("t", *QUANTITIES)}
        return Trajectory(self.name, **cut, file=self.file, declares_units=self.declares_units)


def rate(trajectory: Trajectory) -> float:
    """Samples per second outside gaps [Hz], from the mean step: the median of jittered steps is biased."""
    steps = np.diff(trajectory.t)
    return float(1.0 / steps[steps <= GAP * np.median(steps)].mean()) if steps.size else 0.0


def gap_ends(t: np.ndarray) -> list[int]:
    """Where the gap-free pieces of these times (T,) begin, and T."""
    steps = np.diff(t)
    if not steps.size:
        return [0, len(t)]
    return [0, *(np.flatnonzero(steps > GAP * np.median(steps)) + 1).tolist(), len(t)]


def split_at_gaps(trajectory: Trajectory) -> list[Trajectory]:
    """The gap-free pieces, in order, all under the trajectory's name."""
    ends = gap_ends(trajectory.t)
    return [trajectory] if len(ends) == 2 else [trajectory[a:b] for a, b in pairwise(ends)]
