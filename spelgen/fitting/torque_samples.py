"""The samples that torques are fitted on: blocks that can be passed over again and again, in memory or on disk."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Sequence
from typing import IO

import numpy as np
import torch

from spelgen.identification.samples import DynamicsSamples

Block = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]
"""q, qd, qdd and tau, (T, n)."""

COLUMNS = ("q", "qd", "qdd", "tau")


class TorqueSamples:
    """Samples (count, n) of q, qd, qdd and tau; `blocks` gives them, at most so many at a time. seen: the samples
    that these were taken from.

    In the memory, or of a log larger than that in a temporary file (TMPDIR says where), which goes with this object.
    """

    def __init__(self, joints: int) -> None:
        self.joints, self.count, self.seen = joints, 0, 0
        self._held: list[torch.Tensor] = []
        self._file: IO[bytes] | None = None

    @classmethod
    def held(cls, samples: Sequence[DynamicsSamples], decimation: int = 1) -> TorqueSamples:
        """Of these samples, of each trajectory one of so many, in memory."""
        found = cls(samples[0].q.shape[1])
        columns = [np.concatenate([getattr(x, name)[::decimation] for x in samples]) for name in COLUMNS]
        found._held, found.count = [torch.from_numpy(x) for x in columns], len(columns[0])
        found.seen = sum(len(x.q) for x in samples)
        return found

    @classmethod
    def spooled(cls, samples: Iterable[DynamicsSamples], joints: int, decimation: int = 1) -> TorqueSamples:
        """Of samples that are too many for memory, of each trajectory one of so many, in a temporary file."""
        found = cls(joints)
        found._file = tempfile.TemporaryFile(prefix="spelgen-")  # noqa: SIM115
        for each in samples:
            rows = np.concatenate([getattr(each, name)[::decimation] for name in COLUMNS], axis=1)
            found._file.write(np.ascontiguousarray(rows).data)
            found.count += len(rows)
            found.seen += len(each.q)
        return found

    def thinned(self, most: int) -> TorqueSamples:
        """At most that many of them, evenly spread, in memory."""
        every = -(-self.count // most)
        found = TorqueSamples(self.joints)
        size = every * max(1, most // 8)
        rows = zip(*((x[::every] for x in block) for block in self.blocks(size)), strict=True)
        found._held = [torch.cat(column) for column in rows]
        found.count = found.seen = len(found._held[0])
        return found

    def blocks(self, size: int) -> Iterator[Block]:
        """All samples in order, at most ``size`` at a time."""
        if self._file is None:
            for start in range(0, self.count, size):
                q, qd, qdd, tau = (x[start : start + size] for x in self._held)
                yield q, qd, qdd, tau
            return
        self._file.seek(0)
        width = 4 * self.joints
        while len(numbers := np.frombuffer(self._file.read(8 * width * size))):
            rows = torch.from_numpy(numbers.reshape(-1, width).copy())
            q, qd, qdd, tau = (x.contiguous() for x in rows.split(self.joints, dim=1))
            yield q, qd, qdd, tau

    def torque_deviation(self, gains: torch.Tensor, size: int) -> torch.Tensor:
        """Standard deviations (n,) of ``gains`` (n, n) times the torques."""
        if self.count <= size:
            return next(self.blocks(size))[3].matmul(gains.mT).std(dim=0)
        mean = torch.stack([tau.sum(dim=0) for *_, tau in self.blocks(size)]).sum(dim=0) / self.count
        squares = [((tau - mean) @ gains.mT).square().sum(dim=0) for *_, tau in self.blocks(size)]
        return (torch.stack(squares).sum(dim=0) / (self.count - 1)).sqrt()
