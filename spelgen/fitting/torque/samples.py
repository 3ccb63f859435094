"""The samples that torques are fitted on: tensors of all logs, passed over block by block."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from spelgen.logs.dynamics_samples import DynamicsSamples


class Block(NamedTuple):
    """q, qd, qdd and tau, (T, n), and z and direction of friction (see `DynamicsSamples`); None: not known."""

    q: torch.Tensor
    qd: torch.Tensor
    qdd: torch.Tensor
    tau: torch.Tensor
    z: torch.Tensor | None = None
    direction: torch.Tensor | None = None

    def rows(self, rows: slice) -> Block:
        """Return these samples alone."""
        return Block._make(None if column is None else column[rows].contiguous() for column in self)


@dataclass(frozen=True, eq=False)
class TorqueSamples:
    """Samples of all trajectories, one after the other.

    seen: the samples that these were taken from. step: samples from one to the next, of those that were decimated
    alone.
    """

    columns: Block
    seen: int
    step: int = 1

    @classmethod
    def of(cls, trajectories: Iterable[DynamicsSamples], decimation: int = 1) -> TorqueSamples:
        """Take one of so many samples of each trajectory."""
        pieces, seen = [], 0
        for samples in trajectories:
            columns = (getattr(samples, name) for name in Block._fields)
            # a copy: a slice would keep all samples in memory
            pieces.append([x if x is None else np.ascontiguousarray(x[::decimation]) for x in columns])
            seen += len(samples.q)
        return cls(Block._make(map(_joined, zip(*pieces, strict=True))), seen)

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self.columns.q)

    def thinned(self, count: int) -> TorqueSamples:
        """Return at most that many of them, evenly spread; these themselves where there are no more."""
        step = -(-self.count // count)
        if step <= 1:
            return self
        return TorqueSamples(self.columns.rows(slice(None, None, step)), self.seen, step * self.step)

    def rows(self, rows: slice) -> TorqueSamples:
        """Return these samples alone."""
        return TorqueSamples(self.columns.rows(rows), self.seen, self.step)

    def blocks(self, size: int) -> Iterator[Block]:
        """Yield all samples in order, at most ``size`` at a time."""
        for start in range(0, self.count, size):
            yield self.columns.rows(slice(start, start + size))


def _joined(columns: tuple[np.ndarray | None, ...]) -> torch.Tensor | None:
    arrays = [column for column in columns if column is not None]
    return torch.from_numpy(np.concatenate(arrays)) if arrays else None
