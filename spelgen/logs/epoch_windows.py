"""Windows of logs larger than memory: drawn chunk by chunk, some for each epoch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from spelgen.dynamics.bristles import BristleReach
from spelgen.logs.chunks import Chunk
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.windows import Windows, cut_windows, joined, thinned, window_count

EPOCH = 2**17  # windows of an epoch, about: of 7 joints and 5 samples, 107 MB


@dataclass(frozen=True, eq=False)
class WindowCutting:
    """How windows are cut: see `cut_windows`. preprocessing: a resolved one."""

    window: int
    stride: int
    preprocessing: Preprocessing
    reach: BristleReach | None = None

    @property
    def decimation(self) -> int:
        """Samples from one sample of a window to the next."""
        return self.preprocessing.decimation or 1

    @property
    def shortest(self) -> int:
        """Samples of one window."""
        return (self.window - 1) * self.decimation + 1

    def count(self, piece: int) -> int:
        """Windows of a gap-free piece of so many samples."""
        return window_count(piece, self.window, self.stride, self.decimation)

    def windows(self, trajectories: Sequence[Trajectory]) -> Windows:
        """All windows of these trajectories, filtered piece by piece."""
        pieces = self.preprocessing.pieces(trajectories, shortest=self.shortest)
        filtered = self.preprocessing.filtered
        return cut_windows(
            pieces, self.window, self.stride, self.decimation, measured=filtered, reach=self.reach
        )


@dataclass(frozen=True)
class EpochWindows:
    """All windows of chunks, without holding them. counts: windows of each chunk, at least one."""

    chunks: tuple[Chunk, ...]
    counts: tuple[int, ...]
    cutting: WindowCutting
    seed: int

    def __len__(self) -> int:
        return sum(self.counts)

    @property
    def epochs_per_pass(self) -> int:
        """Epochs in which all windows are passed over once."""
        return min(len(self.chunks), -(-len(self) // EPOCH))

    def drawn(self, number: int) -> list[int]:
        """The chunks of one epoch: each pass over all chunks takes each once, in an order of its own.

        It depends on the number and the seed alone, so that a resumed run draws the same.
        """
        turn, place = divmod(number, self.epochs_per_pass)
        order = np.random.default_rng([self.seed, turn]).permutation(len(self.chunks))
        return sorted(np.array_split(order, self.epochs_per_pass)[place].tolist())

    def sample(self, most_chunks: int, most: int) -> Windows:
        """About `most` windows, evenly spread over at most so many chunks, evenly spread themselves."""
        chosen = range(0, len(self.chunks), -(-len(self.chunks) // most_chunks))
        each = max(1, most // len(chosen))
        # joined one by one: a slice would keep all windows of its chunk
        return joined([joined([thinned(self.windows([index]), each)]) for index in chosen])

    def windows(self, chunks: Sequence[int]) -> Windows:
        """All windows of these chunks, in their order."""
        found = joined([self.cutting.windows([self.chunks[index].load()]) for index in chunks])
        pa.default_memory_pool().release_unused()
        return found
