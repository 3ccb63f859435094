"""Cut windows from logs of commanded positions, and compute what the arm's bodies are to its drives along them.

The bodies' load is taken along the measured motion, so that in a fit each joint is rolled out by itself: the predicted
motion is a hundredth of a radian away, and as far off is what the arm weighs there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from spelgen.dynamics.body_regressor import regressor_of
from spelgen.errors import LogError
from spelgen.fitting.servo.tuning import ServoWindowTuning
from spelgen.logs.commands import LogRows, delayed_commands, steps_between
from spelgen.logs.filtering import derivative, velocities
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory, split_at_gaps

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel

TUNING = ServoWindowTuning()
SHORTEST = 8  # samples, of which half are judged
BLOCK = 2**13  # samples at a time


class Path(NamedTuple):
    """Hold a motion along windows, between samples: means of q, qd and qdd, (W, K-1, n)."""

    q: torch.Tensor
    qd: torch.Tensor
    qdd: torch.Tensor


@dataclass(frozen=True, eq=False)
class ServoWindows:
    """Hold q and, smoothed, qd (W, K, n), and dt (W, K-1) [s].

    parts: the rows of logs. settling: samples at the start of each window that are not judged, in which friction's
    state forms. steps: of the rollout between samples.
    """

    parts: tuple[LogRows, ...]
    q: torch.Tensor
    qd: torch.Tensor
    dt: torch.Tensor
    settling: int
    steps: int

    @property
    def rate(self) -> float:
        """Return the sample rate [Hz]."""
        return float(1 / self.dt.mean())

    def thinned(self, count: int) -> ServoWindows:
        """Return at most so many of the windows, evenly spread, with half the steps."""
        rows = slice(None, None, -(-len(self.q) // count))
        return ServoWindows(
            self.parts[rows], self.q[rows], self.qd[rows], self.dt[rows], self.settling, -(-self.steps // 2)
        )

    def stretches(self, logs: int, count: int) -> torch.Tensor:
        """Return the number (W,) of the stretch that each window is of: logs, or where there are fewer than so many,
        equal parts of them, at least ``count``.
        """
        names, log_numbers = np.unique([log.name for log, _ in self.parts], return_inverse=True)
        cuts = 1 if len(names) >= logs else -(-count // len(names))
        stretches = log_numbers * cuts
        for number in range(len(names)):
            windows = np.flatnonzero(log_numbers == number)
            stretches[windows] += np.arange(len(windows)) * cuts // len(windows)
        # of a log with fewer windows than cuts, some stretches have none
        return torch.from_numpy(np.unique(stretches, return_inverse=True)[1])

    def path(self, q: torch.Tensor | None = None, qd: torch.Tensor | None = None) -> Path:
        """Return the measured motion.

        q, qd: predicted, of which only what they miss is smoothed: so fast motion stays.
        """
        if q is None or qd is None:
            q = qd = torch.zeros_like(self.q)
        missed = (self.q - q).numpy()
        slow_qd, slow_qdd = (torch.from_numpy(derivative(missed, self.rate, order)) for order in (1, 2))
        acceleration = qd.diff(dim=1) / self.dt.unsqueeze(-1)
        return Path(
            _midpoints(self.q), _midpoints(slow_qd) + _midpoints(qd), _midpoints(slow_qdd) + acceleration
        )

    def commands(self, delay: float) -> torch.Tensor:
        """Return those of ``delay`` [s] ago, over the steps between samples (W, K-1, S, n)."""
        commands = [delayed_commands(log, rows, delay, self.steps) for log, rows in self.parts]
        return torch.from_numpy(np.stack(commands))


def _midpoints(x: torch.Tensor) -> torch.Tensor:
    return x[:, 1:] / 2 + x[:, :-1] / 2


def servo_windows(
    logs: Sequence[Trajectory], preprocessing: Preprocessing, count: int = TUNING.count
) -> ServoWindows:
    """Return at most so many windows, evenly spread; shorter ones where all logs are.

    Raises LogError for logs too short.
    """
    pieces: list[Trajectory] = []
    for log in logs:
        pieces += split_at_gaps(log, preprocessing.gap)
    rate = float(np.median([piece.sample_rate for piece in pieces]))
    length = min(round(TUNING.length * rate), max(map(len, pieces)))
    settling = min(round(TUNING.settling * rate), length // 2)
    if length < SHORTEST:
        raise LogError(f"at most {length} samples without a gap", expected="a second of motion or more")
    parts: list[LogRows] = []
    for piece in pieces:
        starts = range(0, len(piece) - length + 1, max(1, length - settling))
        parts += [(piece, slice(start, start + length)) for start in starts]
    parts = parts[:: -(-len(parts) // count)]  # of all motions, rather than the first ones
    smooth_velocities = {id(piece): velocities(piece) for piece in pieces if len(piece) >= length}
    q, qd, dt, steps = [], [], [], 0
    for log, rows in parts:
        q.append(log.q[rows])
        qd.append(smooth_velocities[id(log)][rows])
        dt.append(np.diff(log.t[rows]))
        steps = max(steps, steps_between(log))
    tensors = torch.from_numpy(np.stack(q)), torch.from_numpy(np.stack(qd)), torch.from_numpy(np.stack(dt))
    return ServoWindows(tuple(parts), *tensors, settling, steps)


class BodyLoad(NamedTuple):
    """Hold what the bodies are to the drives along windows.

    inertia: (W, K-1, n) of each joint by itself, without the drives'. bias: the torque (W, K-1, n) that everything else
    takes, gravity: its part of that. slopes: of the torque by the ten parameters of all bodies, (W, K-1, n, 10 B).
    """

    inertia: torch.Tensor
    bias: torch.Tensor
    gravity: torch.Tensor
    slopes: torch.Tensor


def body_load(model: ArmModel, path: Path) -> BodyLoad:
    """Return that of the model as it is."""
    blocks: list[BodyLoad] = []
    with torch.no_grad():
        prepared, armature = model.prepare(), model.armature
        flat = [x.flatten(0, 1).split(BLOCK) for x in path]
        for q, qd, qdd in zip(*flat, strict=True):
            at = model.configuration(q, prepared)
            mass = at.mass
            inertia = mass.diagonal(dim1=-2, dim2=-1) - armature
            coupling = (mass @ qdd.unsqueeze(-1)).squeeze(-1) - (inertia + armature) * qdd
            bias = model.nonlinear_effects(at, qd) + coupling
            slopes = regressor_of(model.chain, q, qd, qdd)
            blocks.append(BodyLoad(inertia, bias, model.gravity(at), slopes))
    shape = path.q.shape[:2]
    return BodyLoad(*(torch.cat(columns).unflatten(0, shape) for columns in zip(*blocks, strict=True)))
