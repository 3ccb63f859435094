"""The samples that torques are fitted on: blocks that can be passed over again and again, in memory or on disk."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Sequence
from typing import IO

import numpy as np
import torch

from spelgen.identification.samples import DynamicsSamples

Block = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]
"""q, qd, qdd and tau, (T, n), and z, (T, n, K)."""


class TorqueSamples:
    """Samples (count, n) of q, qd, qdd and tau, and z, (count, n, K); `blocks` gives them, at most so many at a
    time. seen: the samples that these were taken from.

    In the memory, or of a log larger than that in a temporary file (TMPDIR says where), which goes with this object.
    """

    def __init__(self, joints: int, elements: int = 0) -> None:
        self.joints, self.elements, self.count, self.seen = joints, elements, 0, 0
        self._held: list[torch.Tensor] = []
        self._file: IO[bytes] | None = None

    @classmethod
    def held(cls, samples: Sequence[DynamicsSamples], decimation: int = 1) -> TorqueSamples:
        """Of these samples, of each trajectory one of so many, in memory."""
        columns = [np.concatenate(x) for x in zip(*(_columns(x, decimation) for x in samples), strict=True)]
        found = cls(columns[-1].shape[1], columns[-1].shape[2])
        found._held, found.count = [torch.from_numpy(x) for x in columns], len(columns[0])
        found.seen = sum(len(x.q) for x in samples)
        return found

    @classmethod
    def spooled(
        cls, samples: Iterable[DynamicsSamples], joints: int, elements: int = 0, decimation: int = 1
    ) -> TorqueSamples:
        """Of samples that are too many for memory, of each trajectory one of so many, in a temporary file."""
        found = cls(joints, elements)
        found._file = tempfile.TemporaryFile(prefix="spelgen-")  # noqa: SIM115
        for each in samples:
            rows = np.concatenate([x.reshape(len(x), -1) for x in _columns(each, decimation)], axis=1)
            found._file.write(np.ascontiguousarray(rows).data)
            found.count += len(rows)
            found.seen += len(each.q)
        return found

    def thinned(self, most: int) -> TorqueSamples:
        """At most that many of them, evenly spread, in memory."""
        every = -(-self.count // most)
        found = TorqueSamples(self.joints, self.elements)
        size = every * max(1, most // 8)
        rows = zip(*((x[::every] for x in block) for block in self.blocks(size)), strict=True)
        found._held = [torch.cat(column) for column in rows]
        found.count = found.seen = len(found._held[0])
        return found

    def blocks(self, size: int) -> Iterator[Block]:
        """All samples in order, at most ``size`` at a time."""
        if self._file is None:
            for start in range(0, self.count, size):
                q, qd, qdd, tau, z = (x[start : start + size] for x in self._held)
                yield q, qd, qdd, tau, z
            return
        self._file.seek(0)
        n, bristles = self.joints, self.joints * self.elements
        while len(numbers := np.frombuffer(self._file.read(8 * (4 * n + bristles) * size))):
            rows = torch.from_numpy(numbers.reshape(-1, 4 * n + bristles).copy())
            q, qd, qdd, tau, z = (x.contiguous() for x in rows.split([n, n, n, n, bristles], dim=1))
            yield q, qd, qdd, tau, z.unflatten(1, (n, self.elements))

    def torque_deviation(self, gains: torch.Tensor, size: int) -> torch.Tensor:
        """Standard deviations (n,) of ``gains`` (n, n) times the torques."""
        if self.count <= size:
            return next(self.blocks(size))[3].matmul(gains.mT).std(dim=0)
        mean = torch.stack([tau.sum(dim=0) for _, _, _, tau, _ in self.blocks(size)]).sum(dim=0) / self.count
        squares = [((tau - mean) @ gains.mT).square().sum(dim=0) for _, _, _, tau, _ in self.blocks(size)]
        return (torch.stack(squares).sum(dim=0) / (self.count - 1)).sqrt()


def _columns(samples: DynamicsSamples, decimation: int) -> list[np.ndarray]:
    z = np.zeros((*samples.q.shape, 0)) if samples.z is None else samples.z
    return [x[::decimation] for x in (samples.q, samples.qd, samples.qdd, samples.tau, z)]
