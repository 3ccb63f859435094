"""The samples that torques are fitted on: blocks that can be passed over again and again, in memory or on disk."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Sequence
from typing import IO

import numpy as np
import torch

from spelgen.logs.dynamics_samples import DynamicsSamples

Block = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]
"""q, qd, qdd and tau, (T, n), and z with the direction of friction without memory, (T, n, K or K + 1)."""


class TorqueSamples:
    """Samples (count, n) of q, qd, qdd and tau, and z, (count, n, K); `blocks` gives them, at most so many at a
    time. seen: the samples that these were taken from.

    In the memory, or of a log larger than that in a temporary file (TMPDIR says where), which goes with this object.
    """

    def __init__(self, joints: int, elements: int = 0) -> None:
        self.joints, self.elements, self.count, self.seen = joints, elements, 0, 0
        self._columns: list[torch.Tensor] = []
        self._file: IO[bytes] | None = None

    @classmethod
    def held(cls, trajectories: Sequence[DynamicsSamples], decimation: int = 1) -> TorqueSamples:
        """Take one of so many samples of each trajectory, in memory."""
        rows = [_columns(samples, decimation) for samples in trajectories]
        columns = [torch.from_numpy(np.concatenate(column)) for column in zip(*rows, strict=True)]
        table = cls(columns[-1].shape[1], columns[-1].shape[2])
        table._columns, table.count = columns, len(columns[0])
        table.seen = sum(len(samples.q) for samples in trajectories)
        return table

    @classmethod
    def spooled(
        cls, trajectories: Iterable[DynamicsSamples], joints: int, elements: int = 0, decimation: int = 1
    ) -> TorqueSamples:
        """Take one of so many samples of each trajectory, too many for memory, in a temporary file."""
        table = cls(joints, elements)
        table._file = tempfile.TemporaryFile(prefix="spelgen-")  # noqa: SIM115
        for samples in trajectories:
            columns = [column.reshape(len(column), -1) for column in _columns(samples, decimation)]
            rows = np.concatenate(columns, axis=1)
            table._file.write(np.ascontiguousarray(rows).data)
            table.count += len(rows)
            table.seen += len(samples.q)
        return table

    def thinned(self, count: int) -> TorqueSamples:
        """Return at most that many of them, evenly spread, in memory."""
        step = -(-self.count // count)
        table = TorqueSamples(self.joints, self.elements)
        blocks = []
        for block in self.blocks(step * max(1, count // 8)):
            blocks.append([column[::step] for column in block])
        table._columns = [torch.cat(column) for column in zip(*blocks, strict=True)]
        table.count = table.seen = len(table._columns[0])
        return table

    def blocks(self, size: int) -> Iterator[Block]:
        """Yield all samples in order, at most ``size`` at a time."""
        if self._file is not None:
            yield from self._read(self._file, size)
            return
        for start in range(0, self.count, size):
            q, qd, qdd, tau, z = (column[start : start + size] for column in self._columns)
            yield q, qd, qdd, tau, z

    def _read(self, file: IO[bytes], size: int) -> Iterator[Block]:
        file.seek(0)
        n, bristles = self.joints, self.joints * self.elements
        width = 4 * n + bristles
        while len(numbers := np.frombuffer(file.read(8 * width * size))):
            rows = torch.from_numpy(numbers.reshape(-1, width).copy())
            q, qd, qdd, tau, z = (column.contiguous() for column in rows.split([n, n, n, n, bristles], dim=1))
            yield q, qd, qdd, tau, z.unflatten(1, (n, self.elements))

    def torque_deviation(self, gains: torch.Tensor, size: int) -> torch.Tensor:
        """Return standard deviations (n,) of ``gains`` (n, n) times the torques."""
        if self.count <= size:
            return next(self.blocks(size))[3].matmul(gains.mT).std(dim=0)
        total, squares = torch.zeros(2, self.joints).double()
        for _, _, _, tau, _ in self.blocks(size):
            total += tau.sum(dim=0)
        for _, _, _, tau, _ in self.blocks(size):
            squares += ((tau - total / self.count) @ gains.mT).square().sum(dim=0)
        result: torch.Tensor = (squares / (self.count - 1)).sqrt()
        return result


def _columns(samples: DynamicsSamples, decimation: int) -> list[np.ndarray]:
    z = samples.z
    if z is None:
        z = np.zeros((*samples.q.shape, 0))
    if samples.direction is not None:
        z = np.concatenate([z, samples.direction[..., None]], axis=2)
    return [column[::decimation] for column in (samples.q, samples.qd, samples.qdd, samples.tau, z)]
