"""Logs -> samples on which accelerations can be had: filtered, at one rate, where the arm moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from spelgen.dynamics.bristles import BristleReach, bristles_along
from spelgen.logs.filtering import AUTOMATIC_CUTOFF, low_pass, low_pass_regular, resample
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory

FREQUENCY = 100.0  # [Hz] of the common grid
MOVING = 0.02  # [rad/s, m/s] samples at which every joint is slower say nothing of dynamics
DENSE = 50.0  # [Hz] below this rate accelerations cannot be had from a log
SHORTEST = 1.0  # [s] pieces below this are all filter transient
HOLE = 0.25 / AUTOMATIC_CUTOFF  # [s] a shorter one loses nothing that the filter lets through
AUTOMATIC = Preprocessing()


@dataclass(frozen=True, eq=False)
class DynamicsSamples:
    """Samples (T, n) of one trajectory: q, qd, qdd [rad, s; m, s] and tau [Nm, N] as logged.

    z: (T, n, K) [rad, m], friction's memory of the way there; None: not known.
    """

    name: str
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    tau: np.ndarray
    z: np.ndarray | None = None


def dynamics_samples(
    trajectories: Sequence[Trajectory],
    *,
    pauses: bool = False,
    preprocessing: Preprocessing = AUTOMATIC,
    reach: BristleReach | None = None,
) -> list[DynamicsSamples]:
    """The moving samples of each dense enough trajectory.

    At 100 Hz, through the zero-phase low-pass of ``preprocessing``, by default of 8 Hz, on q, qd and tau (before the
    change of rate where the log is denser, after it where not), qdd by central differences of the filtered qd, only
    samples with some |qd| > 0.02 rad/s; pieces between gaps separately. ``pauses``: all samples from the first that
    moves to the last, standstill between them included. ``reach``: of the bristles whose states z are
    wanted, through the same filter; see ``bristles_along``.
    """
    return [
        _samples(x, pauses, preprocessing, reach)
        for x in trajectories
        if x.sample_rate >= DENSE and any(map(_long, _pieces(x, preprocessing.gap)))
    ]


def _pieces(trajectory: Trajectory, gap: float) -> list[Trajectory]:
    steps = np.diff(trajectory.t)
    if not steps.size:
        return [trajectory]
    holes = steps > max(gap * np.median(steps), HOLE)
    ends = [0, *(np.flatnonzero(holes) + 1), len(trajectory.t)]
    return [trajectory[start:stop] for start, stop in pairwise(ends)]


def _long(piece: Trajectory) -> bool:
    return bool(piece.t[-1] - piece.t[0] >= SHORTEST)


def _samples(
    trajectory: Trajectory, pauses: bool, preprocessing: Preprocessing, reach: BristleReach | None
) -> DynamicsSamples:
    parts = []
    for piece in filter(_long, _pieces(trajectory, preprocessing.gap)):
        smooth = _at_common_rate(piece, preprocessing.acceleration_cutoff)
        qdd = np.gradient(smooth.qd, smooth.t, axis=0)
        taken = (np.abs(smooth.qd) > MOVING).any(axis=1)
        if pauses and taken.any():
            first, *_, last = np.flatnonzero(taken)
            taken[first:last] = True
        columns = [smooth.q, smooth.qd, qdd, smooth.tau]
        if reach is not None and reach.elements:
            z, cutoff = bristles_along(smooth.q, reach), preprocessing.acceleration_cutoff
            # the torque's steps where joints turn around went through the filter, so must these
            columns.append(z if cutoff is None else low_pass_regular(z, FREQUENCY, cutoff))
        parts.append([x[taken] for x in columns])
    return DynamicsSamples(
        trajectory.name, *(np.concatenate(columns) for columns in zip(*parts, strict=True))
    )


def _at_common_rate(piece: Trajectory, cutoff: float | None) -> Trajectory:
    if cutoff is None:
        return resample(piece, FREQUENCY)
    if piece.sample_rate > 1.5 * FREQUENCY:
        return resample(low_pass(piece, cutoff), FREQUENCY)
    return low_pass(resample(piece, FREQUENCY), cutoff)
