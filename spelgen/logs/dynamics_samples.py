"""Filtered samples of a moving arm with accelerations and torques, at a common sample rate, for fits of dynamics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from spelgen.dynamics.bristles import BristleReach, bristles_along, direction_along
from spelgen.logs.filtering import interpolated, low_passed, regular_times, require_cutoff, resampled
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory, split_at_gaps
from spelgen.logs.tuning import SAMPLES, TUNING, shows_accelerations

FREQUENCY = 100.0  # [Hz] common sample rate: twelve times the cutoff of the low-pass filter
SHORTEST = 1.0  # [s] shortest gap-free piece that is used: shorter pieces consist of filter transients
# [s] Shortest gap at which a recording is cut: the filter would remove any signal within a shorter gap.
HOLE = 0.25 / TUNING.automatic_cutoff
AUTOMATIC = Preprocessing()


@dataclass(frozen=True, eq=False)
class DynamicsSamples:
    """Samples of one trajectory: q, qd, qdd [rad, s; m, s] and tau [Nm, N], each (T, n); tau as logged.

    z: (T, n, K) [rad, m] states of the K friction bristles of each joint, computed from the history of motion; None if
    not computed. direction: (T, n) smoothed sign of the velocity for dry friction without a state, with the same filter
    as tau; None if not computed. rate: sample rate [Hz].
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
        """Return the samples in a slice of rows; a step of the slice lowers the sample rate."""
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
    """Return the samples of each trajectory at which a joint moves (|qd| > 0.02 rad/s or m/s).

    Trajectories whose sample rate is too low for accelerations are omitted.

    Each gap-free piece is filtered and resampled to 100 Hz; the sample rate of a log must be at least 24 Hz, see
    `resampled`. Logs below 100 Hz are resampled first, faster logs are filtered first. The filter is the zero-phase
    low-pass of ``preprocessing``, by default with a cutoff of 8 Hz, for q, qd and tau. Its transients at both ends are
    removed. qdd is the central difference of the filtered qd.

    pauses: whether samples at standstill between the first and the last motion are returned, too. reach: break-away
    displacements of the bristles whose states z are computed and filtered like tau; see ``bristles_along``.
    """
    samples = []
    for trajectory in preprocessing.moved(trajectories):
        pieces = long_pieces(trajectory, preprocessing.gap)
        if not pieces or not shows_accelerations(trajectory.sample_rate):
            continue
        columns = [_columns(piece, pauses, preprocessing.acceleration_cutoff, reach) for piece in pieces]
        # A single piece, which may be hours long, is not copied.
        joined = columns[0]
        if len(columns) > 1:
            joined = list(map(np.concatenate, zip(*columns, strict=True)))
        samples.append(DynamicsSamples(trajectory.name, *joined))
    return samples


def long_pieces(trajectory: Trajectory, gap: float) -> list[Trajectory]:
    """Return the gap-free pieces of at least 1 s; shorter pieces would consist of filter transients.

    gap: a time step longer than this multiple of the median step is a gap.
    """
    return [piece for piece in split_at_gaps(trajectory, gap, HOLE) if piece.duration >= SHORTEST]


def _columns(
    piece: Trajectory, pauses: bool, cutoff: float | None, reach: BristleReach | None
) -> list[np.ndarray]:
    """Return the columns of `DynamicsSamples` for one piece, at the samples at which a joint moves.

    The columns are q, qd, qdd, tau (T, n) and, if `reach` is given, z (T, n, K) and the direction of friction (T, n).
    pauses: whether samples at rest between the first and the last motion are included. cutoff: cutoff of the low-pass
    filter [Hz]; None: no filter.
    """
    rate, times, t = piece.sample_rate, piece.t, regular_times(piece.t, FREQUENCY)
    is_denser = rate > 1.5 * FREQUENCY

    def sampled(signals: np.ndarray) -> np.ndarray:
        """Return signals, given at the piece's times as (T, ...), filtered and resampled to the common rate."""
        if cutoff is None:
            return resampled(times, signals, t, rate)
        # filtering at the higher of the two rates prevents aliasing: it removes frequencies above half the lower rate
        if is_denser:
            return resampled(times, low_passed(times, signals, cutoff), t, rate)
        return low_passed(t, resampled(times, signals, t, rate), cutoff)

    if cutoff is not None:
        require_cutoff(piece, rate if is_denser else FREQUENCY, cutoff)
    q, qd, tau = sampled(piece.q), sampled(piece.qd), sampled(piece.tau)
    selected = is_moving(qd)
    # If a piece begins or ends during motion, the filter has a transient there, with an error of 20 times the noise.
    # The samples within 0.75 periods of the cutoff from both ends are therefore removed.
    if cutoff is not None:
        unsettled = round(0.75 * FREQUENCY / cutoff)
        selected[:unsettled] = selected[len(selected) - unsettled :] = False
    if pauses and selected.any():
        moving = np.flatnonzero(selected)
        selected[moving[0] : moving[-1]] = True
    columns = [q, qd, np.gradient(qd, t, axis=0), tau]
    if reach is not None and reach.elements:
        # The filter smooths the steps of the torque at reversals of a joint. The friction state has the same filter:
        # the steps of an unfiltered state would differ in time from the steps of the torque by up to one sample, an
        # error that is confounded with inertia.
        path, speed = piece.q, piece.qd
        if cutoff is not None:
            path, speed = interpolated(t, q, times), interpolated(t, qd, times)
        # One bristle is filtered at a time, to limit the memory.
        z = np.moveaxis(bristles_along(path, reach), 2, 0)
        columns.append(np.stack(list(map(sampled, z)), axis=2))
        direction = direction_along(speed, reach)
        if direction is not None:
            columns.append(sampled(direction))
    return columns if selected.all() else [x[selected] for x in columns]


def is_moving(qd: np.ndarray) -> np.ndarray:
    """Return a mask (T,) of the samples at which any joint moves."""
    return np.asarray((np.abs(qd) > SAMPLES.moving).any(axis=1))
