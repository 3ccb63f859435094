"""The samples that torques are fitted on: tensors of all logs, passed over block by block."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from spelgen.logs.dynamics_samples import DynamicsSamples


class Block(NamedTuple):
    """q, qd, qdd and tau, (T, n), and z with the direction of friction without memory, (T, n, K or K + 1)."""

    q: torch.Tensor
    qd: torch.Tensor
    qdd: torch.Tensor
    tau: torch.Tensor
    z: torch.Tensor


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
        rows, seen = [], 0
        for samples in trajectories:
            # a copy: a slice would keep all samples in memory
            rows.append([np.ascontiguousarray(column[::decimation]) for column in _columns(samples)])
            seen += len(samples.q)
        columns = [torch.from_numpy(np.concatenate(column)) for column in zip(*rows, strict=True)]
        return cls(Block(*columns), seen)

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self.columns.q)

    @property
    def joints(self) -> int:
        """How many joints they are of."""
        return self.columns.q.shape[1]

    def thinned(self, count: int) -> TorqueSamples:
        """Return at most that many of them, evenly spread; these themselves where there are no more."""
        step = -(-self.count // count)
        if step <= 1:
            return self
        columns = Block(*(column[::step].contiguous() for column in self.columns))
        return TorqueSamples(columns, self.seen, step * self.step)

    def blocks(self, size: int) -> Iterator[Block]:
        """Yield all samples in order, at most ``size`` at a time."""
        for start in range(0, self.count, size):
            yield Block(*(column[start : start + size] for column in self.columns))


def _columns(samples: DynamicsSamples) -> list[np.ndarray]:
    z = samples.z
    if z is None:
        z = np.zeros((*samples.q.shape, 0))
    if samples.direction is not None:
        z = np.concatenate([z, samples.direction[..., None]], axis=2)
    return [samples.q, samples.qd, samples.qdd, samples.tau, z]
