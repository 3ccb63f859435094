"""Take samples from logs on which accelerations can be had: filtered, at one rate, where the arm moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from spelgen.dynamics.bristles import BristleReach, bristles_along, direction_along
from spelgen.logs.filtering import interpolated, low_passed, regular_times, require_cutoff, resampled
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory, split_at_gaps
from spelgen.logs.tuning import SAMPLES, TUNING, shows_accelerations

FREQUENCY = 100.0  # [Hz] of the common grid: twelve times the cutoff of the low-pass filter
SHORTEST = 1.0  # [s] of a gap-free piece: shorter ones consist of filter transients
HOLE = 0.25 / TUNING.automatic_cutoff  # [s] a shorter one loses nothing that the filter lets through
AUTOMATIC = Preprocessing()


@dataclass(frozen=True, eq=False)
class DynamicsSamples:
    """Samples (T, n) of one trajectory: q, qd, qdd [rad, s; m, s] and tau [Nm, N] as logged.

    z: (T, n, K) [rad, m], states of friction's bristles from the motion before; None: not known.
    direction: (T, n) of dry friction without memory, through the same filter as tau; None: not known. rate: [Hz].
    """

    name: str
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    tau: np.ndarray
    z: np.ndarray | None = None
    direction: np.ndarray | None = None
    rate: float = field(default=FREQUENCY, kw_only=True)

    def __getitem__(self, rows: slice) -> DynamicsSamples:
        """Return the samples of these rows."""
        z = None if self.z is None else self.z[rows]
        direction = None if self.direction is None else self.direction[rows]
        motion = self.q[rows], self.qd[rows], self.qdd[rows], self.tau[rows]
        return DynamicsSamples(self.name, *motion, z, direction, rate=self.rate / (rows.step or 1))


def dynamics_samples(
    trajectories: Sequence[Trajectory],
    *,
    pauses: bool = False,
    preprocessing: Preprocessing = AUTOMATIC,
    reach: BristleReach | None = None,
) -> list[DynamicsSamples]:
    """Return the moving samples of each dense enough trajectory.

    At 100 Hz (logs from 24 Hz on are interpolated, see `resampled`), through the zero-phase low-pass of
    ``preprocessing``, by default of 8 Hz, on q, qd and tau (before the change of rate where the log is denser, after
    it where not), qdd by central differences of the filtered qd, only samples with some |qd| > 0.02 rad/s; pieces
    between gaps separately, without the filter's transient at both ends. ``pauses``: all samples from the first that
    moves to the last, standstill between them included. ``reach``: of the bristles whose states z are wanted, through
    the same filter; see ``bristles_along``.
    """
    samples = []
    for trajectory in preprocessing.moved(trajectories):
        pieces = long_pieces(trajectory, preprocessing.gap)
        if not pieces or not shows_accelerations(trajectory.sample_rate):
            continue
        columns = [_columns(piece, pauses, preprocessing.acceleration_cutoff, reach) for piece in pieces]
        joined = columns[0]  # a single segment, which may be hours long, is not copied
        if len(columns) > 1:
            joined = list(map(np.concatenate, zip(*columns, strict=True)))
        samples.append(DynamicsSamples(trajectory.name, *joined))
    return samples


def long_pieces(trajectory: Trajectory, gap: float) -> list[Trajectory]:
    """Return the pieces between holes that are longer than the transients of a filter."""
    return [piece for piece in split_at_gaps(trajectory, gap, HOLE) if piece.duration >= SHORTEST]


def _columns(
    piece: Trajectory, pauses: bool, cutoff: float | None, reach: BristleReach | None
) -> list[np.ndarray]:
    """Return q, qd, qdd, tau (T, n), and z (T, n, K) if a reach is given, of the selected samples of a piece."""
    rate, times, t = piece.sample_rate, piece.t, regular_times(piece.t, FREQUENCY)
    is_denser = rate > 1.5 * FREQUENCY

    def sampled(signals: np.ndarray) -> np.ndarray:
        """Return signals (T, ...) of the piece's own times at the regular times, filtered."""
        if cutoff is None:
            return resampled(times, signals, t, rate)
        # filtered at the higher of the two rates: frequencies above half the lower rate are removed by then
        if is_denser:
            return resampled(times, low_passed(times, signals, cutoff), t, rate)
        return low_passed(t, resampled(times, signals, t, rate), cutoff)

    if cutoff is not None:
        require_cutoff(piece, rate if is_denser else FREQUENCY, cutoff)
    q, qd, tau = sampled(piece.q), sampled(piece.qd), sampled(piece.tau)
    selected = is_moving(qd)
    # a filter that begins or ends within a motion has a transient, whose error is 20 times the noise for this long
    if cutoff is not None:
        unsettled = round(0.75 * FREQUENCY / cutoff)
        selected[:unsettled] = selected[len(selected) - unsettled :] = False
    if pauses and selected.any():
        moving = np.flatnonzero(selected)
        selected[moving[0] : moving[-1]] = True
    columns = [q, qd, np.gradient(qd, t, axis=0), tau]
    if reach is not None and reach.elements:
        # the torque steps where joints reverse, at the log's own times, and then went through filter and change of
        # rate: so must these, else a step is wrong by up to a sample's time, and is confounded with inertia
        path, speed = piece.q, piece.qd
        if cutoff is not None:
            path, speed = interpolated(t, q, times), interpolated(t, qd, times)
        z = np.moveaxis(bristles_along(path, reach), 2, 0)  # one element at a time: all are as many logs
        columns.append(np.stack(list(map(sampled, z)), axis=2))
        direction = direction_along(speed, reach)
        if direction is not None:
            columns.append(sampled(direction))
    return columns if selected.all() else [x[selected] for x in columns]


def is_moving(qd: np.ndarray) -> np.ndarray:
    """Return in which samples some joint moves, (T,)."""
    return np.asarray((np.abs(qd) > SAMPLES.moving).any(axis=1))
