"""Windows of logs of commanded positions, and what the arm's bodies are to its drives along them.

The bodies' load is taken along the measured motion, so that in a fit each joint is rolled out by itself: the predicted
motion is a hundredth of a radian away, and as far off is what the arm weighs there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch

from spelgen.errors import LogError
from spelgen.logs.commands import delayed_commands, steps_between
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.smoothing import smoothed, velocities
from spelgen.logs.trajectory import Trajectory, split_at_gaps

LENGTH, SETTLING = (
    4.0,
    1.0,
)  # s, of a window, and of its beginning, which is not judged: friction's memory forms there
MOST = 200  # windows
BLOCK = 2**13  # samples at a time


class Path(NamedTuple):
    """A motion along windows, between samples: means of q, qd and qdd, (W, K-1, n)."""

    q: torch.Tensor
    qd: torch.Tensor
    qdd: torch.Tensor


@dataclass(frozen=True, eq=False)
class ServoWindows:
    """q and, smoothed, qd (W, K, n); dt (W, K-1) [s]; `settling` samples at the start of each."""

    pieces: tuple[tuple[Trajectory, int], ...]
    q: torch.Tensor
    qd: torch.Tensor
    dt: torch.Tensor
    settling: int
    steps: int

    @property
    def rate(self) -> float:
        """Samples in a second [Hz]."""
        return float(1 / self.dt.mean())

    def path(self, q: torch.Tensor | None = None, qd: torch.Tensor | None = None) -> Path:
        """The measured motion. q, qd: predicted, of which only what they miss is smoothed: so fast motion stays."""
        missed = self.q if q is None else self.q - q
        slow, slower = (torch.from_numpy(x) for x in smoothed(missed.numpy(), self.rate))
        path = Path(*(x[:, 1:] / 2 + x[:, :-1] / 2 for x in (self.q, slow, slower)))
        if qd is None:
            return path
        faster = qd.diff(dim=1) / self.dt.unsqueeze(-1)
        return Path(path.q, path.qd + qd[:, 1:] / 2 + qd[:, :-1] / 2, path.qdd + faster)

    def commands(self, delay: float) -> torch.Tensor:
        """Of ``delay`` [s] ago, over the steps between samples (W, K-1, S, n)."""
        length = self.q.shape[1]
        found = [delayed_commands(x, slice(a, a + length), delay, self.steps) for x, a in self.pieces]
        return torch.from_numpy(np.stack(found))


def servo_windows(logs: Sequence[Trajectory], preprocessing: Preprocessing, most: int = MOST) -> ServoWindows:
    """About so many windows, evenly spread; shorter ones where all logs are. Raises LogError for logs too short."""
    pieces = [x for log in logs for x in split_at_gaps(log, preprocessing.gap)]
    rate = float(np.median([x.sample_rate for x in pieces]))
    length = min(round(LENGTH * rate), max(map(len, pieces)))
    settling = min(round(SETTLING * rate), length // 2)
    if length < 8:
        raise LogError(f"at most {length} samples without a gap", expected="a second of motion or more")
    starts = [(x, a) for x in pieces for a in range(0, len(x) - length + 1, max(1, length - settling))]
    starts = starts[:: -(-len(starts) // most)]
    smooth = {id(x): velocities(x) for x in pieces if len(x) >= length}
    q, qd = (
        torch.from_numpy(np.stack([source(x)[a : a + length] for x, a in starts]))
        for source in (lambda x: x.q, lambda x: smooth[id(x)])
    )
    dt = torch.from_numpy(np.stack([np.diff(x.t[a : a + length]) for x, a in starts]))
    steps = max(steps_between(x) for x, _ in starts)
    return ServoWindows(tuple(starts), q, qd, dt, settling, steps)


@dataclass(frozen=True, eq=False)
class BodyLoad:
    """What the bodies are to the drives along windows.

    inertia: (W, K-1, n) of each joint by itself, without the drives'. bias: the torque (W, K-1, n) that everything else
    takes, gravity: its part of that. weights: what directions of the bodies' weights add to all of it, (W, K-1, n, r).
    """

    inertia: torch.Tensor
    bias: torch.Tensor
    gravity: torch.Tensor
    weights: torch.Tensor


def body_load(model: Any, path: Path, directions: torch.Tensor) -> BodyLoad:
    """Of the model as it is; directions: of the ten parameters of all bodies, (10 bodies, r)."""
    dynamics = model
    flat = [x.flatten(0, 1) for x in path]
    found: list[tuple[torch.Tensor, ...]] = []
    with torch.no_grad():
        prepared, armature = dynamics.prepare(), dynamics.armature
        for q, qd, qdd in zip(*(x.split(BLOCK) for x in flat), strict=True):
            at = dynamics.configuration(q, prepared)
            mass, residuals = dynamics.mass_at(at, prepared)
            inertia = mass.diagonal(dim1=-2, dim2=-1) - armature
            others = (mass @ qdd.unsqueeze(-1)).squeeze(-1) - (inertia + armature) * qdd
            bias = dynamics.nonlinear_at(at, qd, residuals, prepared) + others
            weights = dynamics.regressor(q, qd, qdd) @ directions
            found.append((inertia, bias, dynamics.gravity_at(at, prepared), weights))
    shape = path.q.shape[:2]
    return BodyLoad(*(torch.cat(x).unflatten(0, shape) for x in zip(*found, strict=True)))
