"""Windows of a few samples, cut from gap-free trajectories, and the split of logs into training and validation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view

from spelgen.dynamics.bristles import BristleReach, bristles_along
from spelgen.errors import Diagnostic, LogError
from spelgen.labels import LAST_PART
from spelgen.logs.trajectory import Trajectory, set_aside


@dataclass(frozen=True, eq=False)
class Windows:
    """W windows of K consecutive samples of n joints.

    Attributes:
        dt: (W, K-1) time steps between the samples [s], which need not be equal.
        q: (W, K, n) measured positions [rad, m].
        qd: (W, K, n) measured velocities [rad/s, m/s].
        tau: (W, K-1, n) torques [Nm, N], the input, constant over each step.
        z: (W, n, B) [rad, m] states of the B friction bristles per joint at the first sample of a window, computed from
            the motion before it; None if not computed.
    """

    dt: torch.Tensor
    q: torch.Tensor
    qd: torch.Tensor
    tau: torch.Tensor
    z: torch.Tensor | None = None

    def __len__(self) -> int:
        return self.dt.shape[0]

    def __getitem__(self, rows: torch.Tensor | slice) -> Windows:
        return Windows(*(x[rows] for x in self.columns()))

    def split(self, size: int) -> list[Windows]:
        """Return the W windows divided into consecutive batches of at most `size` windows."""
        return [self[start : start + size] for start in range(0, len(self), size)]

    def to(self, device: str | torch.device) -> Windows:
        """Return the same windows on another torch device."""
        return Windows(*(x.to(device) for x in self.columns()))

    def columns(self) -> list[torch.Tensor]:
        """Return the attributes as a list: dt, q, qd, tau and, if they were computed, the friction states z."""
        columns = [self.dt, self.q, self.qd, self.tau]
        return columns if self.z is None else [*columns, self.z]


def thinned(windows: Windows, count: int) -> Windows:
    """Return an evenly spaced subset of at most ``count`` windows."""
    return windows[:: -(-len(windows) // count)]


def joined(batches: Sequence[Windows]) -> Windows:
    """Return one batch that contains the windows of all batches, in order."""
    columns = zip(*map(Windows.columns, batches), strict=True)
    return Windows(*map(torch.cat, columns))


def cut_windows(
    pieces: Sequence[Trajectory],
    window: int,
    stride: int = 1,
    decimation: int = 1,
    *,
    measured: bool,
    reach: BristleReach | None = None,
) -> Windows:
    """Return all windows of `window` samples of gap-free pieces of logs.

    The input of a step, from one sample of a window to the next, is the time average of the torque over the step.

    Args:
        pieces: trajectories without gaps.
        window: number of samples of a window.
        stride: number of samples of a piece from the start of a window to the start of the next window.
        decimation: number of samples of a piece from one sample of a window to the next.
        measured: if True, tau[k] was measured at t[k], and the torque between two samples is the mean of both; without
            this mean, torques would be delayed by half a sample. If False, tau[k] is constant from t[k] to t[k+1], as
            in a simulation with zero-order hold.
        reach: (n, B) break-away displacements of the B bristles of each joint, whose states z are computed, starting
            from zero at the start of each piece; None: z is not computed.

    Raises:
        LogError: if no piece is long enough for a window.
    """
    span = (window - 1) * decimation
    batches: list[Windows] = []
    for piece in pieces:
        if len(piece) > span:
            tau = piece.tau[:-1]
            if measured:
                tau = (tau + piece.tau[1:]) / 2
            # A step of a window spans `decimation` sample intervals of the log. The torque of a step is the mean of the
            # torques in these intervals, weighted by their durations, which differ if the clock has jitter.
            impulses = tau * np.diff(piece.t)[:, None]
            # Integral of the torque over a step from each sample of the log, (T - decimation, n) [Nm s, N s].
            impulse = sliding_window_view(impulses, decimation, axis=0).sum(axis=-1)
            dt = (piece.t[decimation:] - piece.t[:-decimation])[:, None]
            columns = [(dt, window - 1), (piece.q, window), (piece.qd, window), (impulse / dt, window - 1)]
            steps, *motion = (_slide(values, size, stride, decimation) for values, size in columns)
            tensors = [steps[..., 0], *motion]
            if reach is not None and reach.elements:
                tensors.append(torch.tensor(bristles_along(piece.q, reach)[: len(piece) - span : stride]))
            batches.append(Windows(*tensors))
    if not batches:
        raise LogError(f"no trajectory of {span + 1} samples", expected="one window")
    return joined(batches)


def _slide(values: np.ndarray, window: int, stride: int, decimation: int) -> torch.Tensor:
    """Return a signal (T, n) cut into W windows of `window` samples, (W, window, n).

    stride: number of values between the starts of consecutive windows. decimation: number of values between
    neighbouring samples of a window.
    """
    # The array `values` is made contiguous, since torch does not accept reversed views.
    windows = torch.tensor(np.ascontiguousarray(values)).unfold(0, (window - 1) * decimation + 1, stride)
    return windows[..., ::decimation].transpose(1, 2)


class Split(NamedTuple):
    """Split of logs into trajectories for training and for validation. note: which ones are for validation."""

    training: tuple[Trajectory, ...]
    validation: tuple[Trajectory, ...]
    note: Diagnostic


def split_validation(trajectories: Sequence[Trajectory], fraction: float, seed: int) -> Split:
    """Return the split of trajectories: a random `fraction` of them is for validation, the others are for training.

    At least one trajectory is for validation, and at least one for training. A single trajectory is cut in time: its
    last part, a `fraction` of its duration, is for validation.
    """
    total = len(trajectories)
    if total == 1:
        (trajectory,) = trajectories
        t = trajectory.t
        cut = int(np.searchsorted(t, t[-1] - fraction * trajectory.duration))
        if not cut:
            raise trajectory.error("1 sample", "a motion: samples to fit, and others for validation")
        message = (
            f"only one trajectory: training on its first {t[cut - 1] - t[0]:.3g} s, "
            f"validation on the last {t[-1] - t[cut]:.3g} s"
        )
        note = Diagnostic("info", "validation-split", "logs", None, message)
        last = replace(trajectory[cut:], name=trajectory.name + LAST_PART)
        return Split((trajectory[:cut],), (last,), note)
    # Whole trajectories are used for validation, since neighbouring windows of one trajectory have common samples.
    count = min(max(1, round(fraction * total)), total - 1)
    training, validation = set_aside(trajectories, np.random.default_rng(seed).permutation(total)[:count])
    names = ", ".join(x.name for x in validation) if count <= 3 else f"{count} of {total} trajectories"
    note = Diagnostic("info", "validation-split", "logs", None, f"validation on whole trajectories: {names}")
    return Split(tuple(training), tuple(validation), note)
