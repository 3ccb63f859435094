"""Gap-free trajectories -> batched windows of a few samples, and the split into training and validation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view

from spelgen.dynamics.bristles import BristleReach, bristles_along
from spelgen.errors import Diagnostic, LogError
from spelgen.logs.read import Trajectory


@dataclass(frozen=True, eq=False)
class Windows:
    """W windows of K consecutive samples of n joints, with the log's own times.

    dt: (W, K-1) steps between the samples [s].
    q, qd: (W, K, n) measured positions and velocities.
    tau: (W, K-1, n) the input held over each step.
    z: (W, n, B) [rad, m] friction's memory at the first sample, of the way there; None: not known.
    """

    dt: torch.Tensor
    q: torch.Tensor
    qd: torch.Tensor
    tau: torch.Tensor
    z: torch.Tensor | None = None

    def __len__(self) -> int:
        return self.dt.shape[0]

    def __getitem__(self, rows: torch.Tensor | slice) -> Windows:
        return self._each(lambda x: x[rows])

    def split(self, size: int) -> list[Windows]:
        """Consecutive parts of at most `size` windows."""
        return [self[start : start + size] for start in range(0, len(self), size)]

    def to(self, device: str | torch.device) -> Windows:
        """The same windows on another device."""
        return self._each(lambda x: x.to(device))

    def columns(self) -> list[torch.Tensor]:
        """All that is known."""
        columns = [self.dt, self.q, self.qd, self.tau]
        return columns if self.z is None else [*columns, self.z]

    def _each(self, change: Callable[[torch.Tensor], torch.Tensor]) -> Windows:
        return Windows(*map(change, self.columns()))


def thinned(windows: Windows, most: int) -> Windows:
    """At most that many windows, evenly spread."""
    return windows[:: -(-len(windows) // most)]


def joined(parts: Sequence[Windows]) -> Windows:
    """One batch of all windows, in order."""
    return Windows(*(torch.cat(each) for each in zip(*(x.columns() for x in parts), strict=True)))


def window_count(samples: int, window: int, stride: int, decimation: int) -> int:
    """How many windows `cut_windows` cuts from a piece of so many samples."""
    starts = samples - (window - 1) * decimation
    return max(0, -(-starts // stride))


def cut_windows(
    pieces: Sequence[Trajectory],
    window: int,
    stride: int = 1,
    decimation: int = 1,
    *,
    measured: bool,
    reach: BristleReach | None = None,
) -> Windows:
    """All windows of `window` samples, `decimation` apart, that start at every `stride`-th sample of a piece.

    Between samples the input is held at its mean over time. measured: False reads tau[k] as held from t[k]
    to t[k+1], as a simulator with zero-order hold applied it. True reads it as measured at t[k] and takes
    the mean of both ends for a step; holding tau[k] would be half a sample late. reach: (n, B) of the bristles
    whose states z are wanted, which begin straight with each piece. Raises LogError when there is no window.
    """
    cut = [
        _cut(piece, window, stride, decimation, measured, reach)
        for piece in pieces
        if len(piece.t) > (window - 1) * decimation
    ]
    if not cut:
        raise LogError(f"no trajectory of {(window - 1) * decimation + 1} samples", expected="one window")
    return Windows(*(torch.from_numpy(np.concatenate(parts)) for parts in zip(*cut, strict=True)))


def _cut(
    piece: Trajectory, window: int, stride: int, decimation: int, measured: bool, reach: BristleReach | None
) -> tuple[np.ndarray, ...]:
    held = (piece.tau[:-1] + piece.tau[1:]) / 2 if measured else piece.tau[:-1]
    impulse = sliding_window_view(held * np.diff(piece.t)[:, None], decimation, axis=0).sum(
        axis=-1
    )  # (T - decimation, n)
    dt = (piece.t[decimation:] - piece.t[:-decimation])[:, None]
    steps = [_slide(x, window - 1, stride, decimation) for x in (dt, impulse / dt)]
    states = [_slide(x, window, stride, decimation) for x in (piece.q, piece.qd)]
    columns = (steps[0][..., 0], *states, steps[1])
    if reach is None or not reach.elements:
        return columns
    starts = len(piece.t) - (window - 1) * decimation
    return *columns, bristles_along(piece.q, reach)[:starts:stride]


def _slide(values: np.ndarray, window: int, stride: int, decimation: int) -> np.ndarray:
    """(T, n) -> (W, window, n)."""
    windows = sliding_window_view(values, (window - 1) * decimation + 1, axis=0)[::stride, :, ::decimation]
    return windows.transpose(0, 2, 1)


@dataclass(frozen=True, eq=False)
class Split:
    """Training and validation pieces, which share no sample, and how they were chosen."""

    training: tuple[Trajectory, ...]
    validation: tuple[Trajectory, ...]
    note: Diagnostic


def split_validation(trajectories: Sequence[Trajectory], fraction: float, seed: int) -> Split:
    """Set whole trajectories aside for validation: `fraction` of them, at least one, chosen by the seed.

    A single trajectory is cut once in time, its last part validates.
    """
    if len(trajectories) == 1:
        return _split_in_time(trajectories[0], fraction)
    count = min(max(1, round(fraction * len(trajectories))), len(trajectories) - 1)
    chosen = set(np.random.default_rng(seed).permutation(len(trajectories))[:count].tolist())
    training = tuple(x for i, x in enumerate(trajectories) if i not in chosen)
    validation = tuple(x for i, x in enumerate(trajectories) if i in chosen)
    names = (
        ", ".join(x.name for x in validation)
        if count <= 3
        else f"{count} of {len(trajectories)} trajectories"
    )
    note = Diagnostic("info", "validation-split", "logs", None, f"validation on whole trajectories: {names}")
    return Split(training, validation, note)


def _split_in_time(trajectory: Trajectory, fraction: float) -> Split:
    t = trajectory.t
    cut = int(np.searchsorted(t, t[-1] - fraction * (t[-1] - t[0])))
    parts = trajectory[:cut], replace(trajectory[cut:], name=f"{trajectory.name} (last part)")
    before, after = t[cut - 1] - t[0], t[-1] - t[cut]
    message = (
        f"only one trajectory: training on its first {before:.3g} s, validation on the last {after:.3g} s"
    )
    return Split(parts[:1], parts[1:], Diagnostic("warning", "validation-split", "logs", None, message))
