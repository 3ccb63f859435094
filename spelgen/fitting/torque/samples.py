"""Samples of all logs to which a model is fitted, as tensors, and their division into blocks to limit the memory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch

from spelgen.logs.dynamics_samples import DynamicsSamples


class SampleBlock(NamedTuple):
    """T samples of n joints.

    Attributes:
        q: (T, n) positions [rad, m].
        qd: (T, n) velocities [rad/s, m/s].
        qdd: (T, n) accelerations [rad/s^2, m/s^2].
        tau: (T, n) torques as logged [Nm, N].
        z: (T, n, K) states of the K friction bristles of each joint [rad, m]; None if unknown.
        direction: (T, n) smooth sign of the velocity, between -1 and 1: the factor of dry friction without bristles
            (see `DynamicsSamples`); None if unknown.
    """

    q: torch.Tensor
    qd: torch.Tensor
    qdd: torch.Tensor
    tau: torch.Tensor
    z: torch.Tensor | None = None
    direction: torch.Tensor | None = None

    def select(self, rows: slice | torch.Tensor) -> SampleBlock:
        """Return the samples of rows, a slice or indices."""
        return SampleBlock._make(None if column is None else column[rows].contiguous() for column in self)


@dataclass(frozen=True, eq=False)
class TorqueSamples:
    """Concatenated samples of all trajectories of a fit.

    Attributes:
        columns: the T samples.
        original_count: number of samples before decimation and subsampling.
        interval: time between successive samples [s].
        recordings: (T,), index of the recording to which each sample belongs.
    """

    columns: SampleBlock
    original_count: int
    interval: float
    recordings: torch.Tensor

    @classmethod
    def of(cls, trajectories: Iterable[DynamicsSamples], decimation: int = 1) -> TorqueSamples:
        """Return the concatenation of all trajectories, with every `decimation`-th sample of each."""
        decimated, count, interval = [], 0, 0.0
        names: dict[str, int] = {}
        recordings = []
        for x in trajectories:
            columns = (x.q, x.qd, x.qdd, x.tau, x.z, x.direction)
            # The selected samples are copied, since a view would keep all samples in memory.
            decimated.append(
                [None if column is None else np.ascontiguousarray(column[::decimation]) for column in columns]
            )
            count, interval = count + len(x.q), decimation / x.rate
            # All trajectories cut from one recording have the same index, since their errors are correlated.
            recordings.append(torch.full((len(x.q[::decimation]),), names.setdefault(x.name, len(names))))
        table = SampleBlock._make(map(_concatenated, zip(*decimated, strict=True)))
        return cls(table, count, interval, torch.cat(recordings))

    @property
    def count(self) -> int:
        """Number of samples."""
        return len(self.columns.q)

    def segment_length(self, seconds: float) -> int:
        """Return the number of samples of a segment of `seconds` [s], at most the number of all samples."""
        return min(self.count, max(1, round(seconds / self.interval)))

    def segments(self, seconds: float, max_count: int) -> TorqueSamples:
        """Return at most `max_count` samples: evenly spaced segments of `seconds` [s] each, concatenated."""
        size = self.segment_length(seconds)
        number = max(1, min(self.count, max_count) // size)
        # A segment may span two recordings. Such segments are rare, and negligible for means over segments.
        starts = torch.linspace(0, self.count - size, number).long()
        rows = (starts.unsqueeze(-1) + torch.arange(size)).flatten()
        return self.select(rows)

    def subsampled(self, max_count: int) -> TorqueSamples:
        """Return at most `max_count` evenly spaced samples; this object itself if it has no more samples."""
        # Evenly spaced samples are deterministic and include every motion, in contrast to random ones.
        step = -(-self.count // max_count)
        if step <= 1:
            return self
        return replace(self.select(slice(None, None, step)), interval=step * self.interval)

    def select(self, rows: slice | torch.Tensor) -> TorqueSamples:
        """Return the samples of rows, a slice or indices."""
        return replace(self, columns=self.columns.select(rows), recordings=self.recordings[rows])

    def blocks(self, size: int) -> Iterator[SampleBlock]:
        """Yield all samples in order, at most `size` at a time."""
        for first in range(0, self.count, size):
            yield self.columns.select(slice(first, first + size))


def _concatenated(columns: tuple[np.ndarray | None, ...]) -> torch.Tensor | None:
    arrays = [column for column in columns if column is not None]
    return torch.from_numpy(np.concatenate(arrays)) if arrays else None
