"""Windows of logs of commanded positions, and the load of the arm's bodies on the drives along a motion.

The load is evaluated at measured instead of predicted positions, so that a fit can integrate each joint independently.
The error is small: measured and predicted positions differ by about 0.01 rad, which changes the load by about 1 %.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from spelgen.dynamics.body_regressor import regressor_of
from spelgen.emission.assemble import ArmModel
from spelgen.errors import LogError
from spelgen.fitting.servo.tuning import TUNING
from spelgen.logs.filtering import derivative, velocities
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import LogRows, Trajectory, delayed_commands, split_at_gaps, steps_between
from spelgen.runtime.parts import applied


class MidpointMotion(NamedTuple):
    """Motion of W windows of K samples at the K-1 midpoints between samples, (W, K-1, n) each.

    q: positions [rad, m]. qd: velocities [rad/s, m/s]. qdd: accelerations [rad/s^2, m/s^2].
    """

    q: Tensor
    qd: Tensor
    qdd: Tensor


@dataclass(frozen=True, eq=False)
class ServoWindows:
    """W windows of K samples, cut from logs of commanded and measured positions.

    The commands depend on the delay; `commands` computes them from the logs.

    Attributes:
        rows: (log, slice of its samples) of each window.
        q: measured positions, (W, K, n) [rad, m].
        qd: smoothed derivatives of the measured positions, (W, K, n) [rad/s, m/s].
        dt: (W, K-1), sample intervals [s].
        burn_in: number of samples at the start of each window whose errors are ignored, since the initial friction
            state is unknown.
        steps: number of integration steps per sample interval.
    """

    rows: tuple[LogRows, ...]
    q: Tensor
    qd: Tensor
    dt: Tensor
    burn_in: int
    steps: int

    @property
    def rate(self) -> float:
        """Mean sample rate of the windows [Hz]."""
        return float(1 / self.dt.mean())

    @property
    def moving(self) -> Tensor:
        """True for joints that move within the windows, (n,): the servo of a joint at rest is not determined."""
        return self.q.std(dim=1).square().mean(dim=0).sqrt() > TUNING.min_motion

    def subsampled(self, count: int) -> ServoWindows:
        """Return at most ``count`` of these windows, evenly spread, with half as many integration steps per interval.

        The number of steps is half of this object's `steps`, rounded up: a coarse fit to few windows needs less
        accuracy.
        """
        selection = slice(None, None, -(-len(self.q) // count))
        q, qd, dt = self.q[selection], self.qd[selection], self.dt[selection]
        return ServoWindows(self.rows[selection], q, qd, dt, self.burn_in, -(-self.steps // 2))

    def blocks(self, min_logs: int, min_blocks: int) -> Tensor:
        """Return the block number of each window, (W,), for a jackknife over blocks with independent errors.

        With at least ``min_logs`` logs, each log is one block. Fewer logs are divided into equal segments, each of
        which is one block; the total number of blocks is at least ``min_blocks`` if there are enough windows.
        """
        names, log_numbers = np.unique([log.name for log, _ in self.rows], return_inverse=True)
        segments = 1 if len(names) >= min_logs else -(-min_blocks // len(names))
        blocks = log_numbers * segments
        for number in range(len(names)):
            windows = np.flatnonzero(log_numbers == number)
            blocks[windows] += np.arange(len(windows)) * segments // len(windows)
        # At this point, `blocks` contains log number * segments + index of the segment. A log with fewer windows than
        # segments has segments without windows, whose numbers do not occur. The blocks are therefore renumbered without
        # gaps.
        return torch.from_numpy(np.unique(blocks, return_inverse=True)[1])

    def motion(self, q: Tensor | None = None, qd: Tensor | None = None) -> MidpointMotion:
        """Return measured positions, velocities and accelerations at the K-1 midpoints between samples.

        Without arguments, velocities and accelerations are smoothed derivatives of the measured positions. With a
        predicted motion q, qd (W, K, n), they are the derivatives of the predicted motion plus smoothed derivatives of
        measured minus predicted positions. Fast motion in the prediction is then not attenuated by smoothing.
        """
        if q is None or qd is None:
            q = qd = torch.zeros_like(self.q)
        error = (self.q - q).numpy()
        slow_qd, slow_qdd = (torch.from_numpy(derivative(error, self.rate, order)) for order in (1, 2))
        acceleration = qd.diff(dim=1) / self.dt.unsqueeze(-1)
        velocity = _midpoints(slow_qd) + _midpoints(qd)
        return MidpointMotion(_midpoints(self.q), velocity, _midpoints(slow_qdd) + acceleration)

    def commands(self, delay: float) -> Tensor:
        """Return the delayed commands at the S integration steps of each interval, (W, K-1, S, n) [rad, m].

        delay: delay of the commands [s].
        """
        commands = [delayed_commands(log, rows, delay, self.steps) for log, rows in self.rows]
        return torch.from_numpy(np.stack(commands))


def _midpoints(x: Tensor) -> Tensor:
    """Return the means of each two successive samples, (W, K-1, n), of W windows x of K samples, (W, K, n)."""
    return x[:, 1:] / 2 + x[:, :-1] / 2


def servo_windows(
    logs: Sequence[Trajectory], preprocessing: Preprocessing, count: int = TUNING.count
) -> ServoWindows:
    """Return at most ``count`` windows, evenly spread over the logs.

    The windows have the length `TUNING.length` or, if all segments between gaps are shorter, the length of the longest
    segment. Raises LogError if a window would have fewer than `TUNING.min_samples` samples.
    """
    segments: list[Trajectory] = []
    for log in logs:
        segments += split_at_gaps(log, preprocessing.gap)
    rate = float(np.median([segment.sample_rate for segment in segments]))
    length = min(round(TUNING.length * rate), max(map(len, segments)))
    burn_in = min(round(TUNING.burn_in * rate), length // 2)
    if length < TUNING.min_samples:
        raise LogError(f"at most {length} samples without a gap", expected="a second of motion or more")
    rows: list[LogRows] = []
    for segment in segments:
        starts = range(0, len(segment) - length + 1, max(1, length - burn_in))
        rows += [(segment, slice(start, start + length)) for start in starts]
    # The selected windows are spread over the logs, since some joints may not move at the beginning of the logs.
    rows = rows[:: -(-len(rows) // count)]
    smooth_velocities = {id(segment): velocities(segment) for segment in segments if len(segment) >= length}
    columns = (
        [log.q[samples] for log, samples in rows],
        [smooth_velocities[id(log)][samples] for log, samples in rows],
        [np.diff(log.t[samples]) for log, samples in rows],
    )
    q, qd, dt = (torch.from_numpy(np.stack(column)) for column in columns)
    # The number of integration steps is sufficient for the log with the longest sample interval.
    return ServoWindows(tuple(rows), q, qd, dt, burn_in, max(steps_between(log) for log, _ in rows))


class BodyLoad(NamedTuple):
    """The load of the bodies on the drives, at the K-1 midpoints between the samples of W windows of K samples.

    Attributes:
        inertia: (W, K-1, n), diagonal of M without armature [kg m^2, kg].
        bias: (W, K-1, n) [Nm, N], Coriolis, centrifugal and gravity torque, plus the inertial torque of the
            off-diagonal entries of M.
        gravity: (W, K-1, n), gravity torque [Nm, N].
        regressor: (W, K-1, n, 10 B), derivatives of the inverse-dynamics torque with respect to the inertial parameters
            of B bodies.
    """

    inertia: Tensor
    bias: Tensor
    gravity: Tensor
    regressor: Tensor


def body_load(model: ArmModel, motion: MidpointMotion) -> BodyLoad:
    """Return the load of the bodies of `model` along a motion, as arrays (W, K-1, ...) with the units of `BodyLoad`.

    motion: positions, velocities and accelerations of W windows at the K-1 midpoints between samples.
    """
    batches: list[BodyLoad] = []
    with torch.no_grad():
        prepared, armature = model.prepare(), model.armature
        flat = [x.flatten(0, 1).split(TUNING.batch) for x in motion]
        for q, qd, qdd in zip(*flat, strict=True):
            configuration = model.configuration(q, prepared)
            mass = configuration.mass
            inertia = mass.diagonal(dim1=-2, dim2=-1) - armature
            coupling = applied(mass, qdd) - (inertia + armature) * qdd
            bias = model.nonlinear_effects(configuration, qd) + coupling
            regressor = regressor_of(model.chain, q, qd, qdd)
            batches.append(BodyLoad(inertia, bias, model.gravity(configuration), regressor))
    shape = motion.q.shape[:2]
    return BodyLoad(*(torch.cat(columns).unflatten(0, shape) for columns in zip(*batches, strict=True)))
