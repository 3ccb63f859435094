"""Filtered samples of a moving arm with accelerations and torques, at a common sample rate, for fits of dynamics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from spelgen.dynamics.bristles import BristleReach, bristles_along, direction_along
from spelgen.logs.filtering import interpolated, low_passed, regular_times, require_cutoff, resampled
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory, split_at_gaps
from spelgen.logs.tuning import SAMPLES, SLOWEST, TUNING, shows_accelerations

FREQUENCY = 100.0  # [Hz] common rate of all samples, twelve times the default cutoff of the low-pass filter
# [s] Shorter pieces of a recording between gaps are omitted: filter transients would be more than a fifth of a piece.
SHORTEST = 1.0
NEEDED = f"motion sampled at {SLOWEST:g} Hz or faster, {SHORTEST:g} s without a gap at least"
# [s] A gap in the time stamps divides a recording only if it is longer. A quarter period of the low-pass filter's
# default cutoff is chosen, since the filter removes the fast motion that a shorter gap could hide.
HOLE = 0.25 / TUNING.automatic_cutoff
AUTOMATIC = Preprocessing()


@dataclass(frozen=True, eq=False)
class DynamicsSamples:
    """Filtered samples of one trajectory of n joints at T times.

    Attributes:
        name: name of the trajectory.
        q: (T, n) positions [rad, m].
        qd: (T, n) velocities [rad/s, m/s].
        qdd: (T, n) accelerations [rad/s^2, m/s^2].
        tau: (T, n) torques [Nm, N].
        z: (T, n, K) [rad, m] states of the K friction bristles of each joint, filtered like tau; None if not computed.
        direction: (T, n) smooth sign of the velocity, the factor of dry friction without bristles, filtered like tau;
            None if not computed.
        rate: sample rate [Hz].
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
        """Return the samples in a slice of rows; the sample rate is divided by the step of the slice."""
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

    q, qd and tau of each gap-free piece are filtered and resampled to 100 Hz; logs above 150 Hz are filtered first,
    other logs are resampled first. The filter is the zero-phase low-pass of `preprocessing`, by default with a cutoff
    of 8 Hz; its transients at both ends of a piece are removed. qdd is the central difference of the filtered qd.
    Trajectories sampled below 24 Hz are omitted, since their accelerations are unknown.

    Args:
        trajectories: logs with torques.
        pauses: if True, samples at standstill between the first and the last motion of a piece are returned, too.
        preprocessing: cutoff of the filter, time steps that count as gaps, and delay of the torques.
        reach: break-away displacements (n, K) of the friction bristles; None: bristle states z are not computed.
    """
    samples = []
    for trajectory in preprocessing.moved(trajectories):
        pieces = long_pieces(trajectory, preprocessing.gap)
        if not pieces or not shows_accelerations(trajectory.sample_rate):
            continue
        columns = [_columns(piece, pauses, preprocessing.acceleration_cutoff, reach) for piece in pieces]
        # A single gap-free piece is not concatenated: this would copy its arrays, which may contain hours of samples.
        joined = columns[0]
        if len(columns) > 1:
            joined = list(map(np.concatenate, zip(*columns, strict=True)))
        samples.append(DynamicsSamples(trajectory.name, *joined))
    return samples


def long_pieces(trajectory: Trajectory, gap: float) -> list[Trajectory]:
    """Return the gap-free pieces of a trajectory that last at least 1 s.

    gap: multiple of the median time step. A longer time step is a gap if it is also longer than 0.03 s.
    """
    return [piece for piece in split_at_gaps(trajectory, gap, HOLE) if piece.duration >= SHORTEST]


def _columns(
    piece: Trajectory, pauses: bool, cutoff: float | None, reach: BristleReach | None
) -> list[np.ndarray]:
    """Return the arrays of `DynamicsSamples` for one gap-free piece, at the samples at which a joint moves.

    The arrays are q, qd, qdd and tau, (T, n), then the states z (T, n, K) of K bristles per joint, if `reach` has
    bristles, and the direction (T, n) of dry friction, the smooth sign of the velocity, if `reach` also has a
    `smoothing_velocity`.

    Args:
        piece: gap-free piece of a log.
        pauses: if True, samples at rest between the first and the last motion are included.
        cutoff: cutoff of the low-pass filter [Hz]; None: no filter.
        reach: break-away displacements of the friction bristles; None: z and direction are not computed.
    """
    rate, times, t = piece.sample_rate, piece.t, regular_times(piece.t, FREQUENCY)
    is_denser = rate > 1.5 * FREQUENCY

    def sampled(signals: np.ndarray) -> np.ndarray:
        """Return signals of the piece, (S, n), low-passed and resampled to the regular times t (100 Hz), (T, n)."""
        if cutoff is None:
            return resampled(times, signals, t, rate)
        # A dense log is filtered before it is resampled: resampling first would alias frequencies above 50 Hz.
        if is_denser:
            return resampled(times, low_passed(times, signals, cutoff), t, rate)
        return low_passed(t, resampled(times, signals, t, rate), cutoff)

    if cutoff is not None:
        require_cutoff(piece, rate if is_denser else FREQUENCY, cutoff)
    q, qd, tau = sampled(piece.q), sampled(piece.qd), sampled(piece.tau)
    selected = is_moving(qd)
    # If a piece begins or ends during motion, the filter has a transient at this end, with errors of 20 times the
    # noise. The transient lasts for 0.75 periods of the cutoff frequency; the samples in this time are removed.
    if cutoff is not None:
        unsettled = round(0.75 * FREQUENCY / cutoff)
        selected[:unsettled] = selected[len(selected) - unsettled :] = False
    if pauses and selected.any():
        moving = np.flatnonzero(selected)
        selected[moving[0] : moving[-1]] = True
    columns = [q, qd, np.gradient(qd, t, axis=0), tau]
    if reach is not None and reach.elements:
        # The filter smooths the torque steps at reversals of a joint. The bristle states are therefore computed at the
        # times of the log and filtered like the torque. Unfiltered states would step up to one sample earlier or later
        # than the torque, and a fit would attribute this difference to inertia.
        path, speed = piece.q, piece.qd
        if cutoff is not None:
            path, speed = interpolated(t, q, times), interpolated(t, qd, times)
        # The states of one bristle of all joints are filtered at a time, to limit the memory.
        z = np.moveaxis(bristles_along(path, reach), 2, 0)
        columns.append(np.stack(list(map(sampled, z)), axis=2))
        direction = direction_along(speed, reach)
        if direction is not None:
            columns.append(sampled(direction))
    return columns if selected.all() else [x[selected] for x in columns]


def is_moving(qd: np.ndarray) -> np.ndarray:
    """Return a mask (T,) of the samples at which any joint moves: a velocity in qd (T, n) exceeds 0.02 rad/s or m/s."""
    return np.asarray((np.abs(qd) > SAMPLES.moving).any(axis=1))
