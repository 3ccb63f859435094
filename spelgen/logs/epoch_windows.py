"""Windows of logs larger than memory: drawn part by part, a share for each epoch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from spelgen.logs.chunks import Part
from spelgen.logs.filtering import prepare
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.windows import Windows, cut_windows, joined, thinned, window_count

SHARE = 2**17  # windows of an epoch, about: of 7 joints and 5 samples, 107 MB


@dataclass(frozen=True)
class Cutting:
    """How windows are cut: see `cut_windows`. cutoff: of the filter [Hz], None without."""

    window: int
    stride: int
    every: int
    cutoff: float | None

    @property
    def shortest(self) -> int:
        """Samples of one window."""
        return (self.window - 1) * self.every + 1

    def count(self, piece: int) -> int:
        """Windows of a gap-free piece of so many samples."""
        return window_count(piece, self.window, self.stride, self.every)

    def windows(self, trajectories: Sequence[Trajectory]) -> Windows:
        """All windows of these trajectories, filtered piece by piece."""
        pieces = prepare(trajectories, shortest=self.shortest, cutoff=self.cutoff)
        return cut_windows(pieces, self.window, self.stride, self.every, measured=self.cutoff is not None)


@dataclass(frozen=True)
class WindowStream:
    """All windows of parts, without holding them. counts: windows of each part, at least one."""

    parts: tuple[Part, ...]
    counts: tuple[int, ...]
    cutting: Cutting
    seed: int

    def __len__(self) -> int:
        return sum(self.counts)

    @property
    def shares(self) -> int:
        """Shares in which all windows are passed over once."""
        return min(len(self.parts), -(-len(self) // SHARE))

    def share(self, number: int) -> Windows:
        """The windows of one epoch: each pass over all shares takes each part once, in an order of its own.

        It depends on the number and the seed alone, so that a resumed run draws the same.
        """
        turn, place = divmod(number, self.shares)
        order = np.random.default_rng([self.seed, turn]).permutation(len(self.parts))
        return self._windows(sorted(np.array_split(order, self.shares)[place].tolist()))

    def sample(self, most_parts: int, most: int) -> Windows:
        """About `most` windows, evenly spread over at most so many parts, evenly spread themselves."""
        chosen = range(0, len(self.parts), -(-len(self.parts) // most_parts))
        each = max(1, most // len(chosen))
        # joined one by one: a slice would keep all windows of its part
        return joined([joined([thinned(self._windows([index]), each)]) for index in chosen])

    def _windows(self, parts: Sequence[int]) -> Windows:
        found = joined([self.cutting.windows([self.parts[index].load()]) for index in parts])
        pa.default_memory_pool().release_unused()
        return found
