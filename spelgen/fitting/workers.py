"""Several processes that fit one model together, as `torchrun` starts them; to a process alone this changes nothing.

Each steps on its own part of the windows, and all have the same gradient, the same loss and the same clock, so that
they take the same steps and hold the same weights; the first one writes. torch.distributed carries sums between them.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from torch.nn.parallel import DistributedDataParallel

from spelgen.fitting.rollout import Mean
from spelgen.logs.epoch_windows import EpochWindows
from spelgen.logs.windows import Windows

PartLoss = Callable[[Windows, Mean], torch.Tensor]
"""A mean over windows, given these and what makes of a mean over them that over the windows of all processes."""


@contextmanager
def group(device: str) -> Iterator[str]:
    """Join the processes that `torchrun` started, if it did: over nccl on GPUs, each with its own, else gloo. Gives
    the device of this one.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield device
        return
    on_gpu = device.startswith("cuda")
    dist.init_process_group("nccl" if on_gpu else "gloo")
    try:
        yield f"cuda:{os.environ['LOCAL_RANK']}" if on_gpu else device
    finally:
        dist.destroy_process_group()


def count() -> int:
    """How many they are."""
    return dist.get_world_size() if dist.is_initialized() else 1


def rank() -> int:
    """Which of them this one is; 0 writes and speaks."""
    return dist.get_rank() if dist.is_initialized() else 0


def total(part: torch.Tensor) -> torch.Tensor:
    """The sum of what all of them give."""
    if count() > 1:
        part = part.clone()
        dist.all_reduce(part)
    return part


def own(rows: torch.Tensor) -> torch.Tensor:
    """Of rows that all of them have, the part that is this one's."""
    start, stop = (len(rows) * k // count() for k in (rank(), rank() + 1))
    return rows[start:stop]


def agreed(value: float) -> float:
    """What the first one gives: of a clock, for one."""
    if count() == 1:
        return value
    known = torch.tensor(value, dtype=torch.float64, device=_device())
    dist.broadcast(known, 0)
    return known.item()


def _device() -> str:
    return f"cuda:{os.environ['LOCAL_RANK']}" if dist.get_backend() == "nccl" else "cpu"


@dataclass(frozen=True, eq=False)
class Shard:
    """This process's windows, the first one number `first` of `size` that all processes have together; it is indexed as
    if it held all of them. share: the part of all windows that these are; 0: it has none, and holds one for its shape.
    """

    windows: Windows
    first: int
    size: int
    share: float

    @property
    def q(self) -> torch.Tensor:
        """(W, K, n) of its own windows."""
        return self.windows.q

    def __len__(self) -> int:
        return self.size

    def __getitem__(self, rows: torch.Tensor) -> Shard:
        own = rows[(rows >= self.first) & (rows < self.first + len(self.windows))] - self.first
        if not self.share or not len(own):
            return Shard(self.windows[:1], 0, len(rows), 0.0)
        return Shard(self.windows[own], 0, len(rows), len(own) / len(rows))

    def to(self, device: str) -> Shard:
        """The same on another device."""
        return Shard(self.windows.to(device), self.first, self.size, self.share)


def sharded(counts: Sequence[int], load: Callable[[range], Windows]) -> Windows | Shard:
    """This process's windows of trajectories with so many each: of neighbours, about as many as each process has.

    load: gives the windows of some trajectories. Where it is alone, all.
    """
    if count() == 1:
        return load(range(len(counts)))
    middle = np.cumsum(counts) - np.array(counts) / 2
    own = np.flatnonzero((middle * count() / sum(counts)).astype(int) == rank())
    if not len(own):
        return Shard(load(range(1))[:1], 0, sum(counts), 0.0)
    start, stop = int(own[0]), int(own[-1]) + 1
    windows = load(range(start, stop))
    return Shard(windows, sum(counts[:start]), sum(counts), len(windows) / sum(counts))


def shard(windows: Windows, counts: Sequence[int]) -> Windows | Shard:
    """As `sharded`, of windows in memory; fewer trajectories than processes are cut."""
    counts = counts if len(counts) >= count() else [1] * len(windows)
    ends = np.concatenate([[0], np.cumsum(counts)]).tolist()
    return sharded(counts, lambda own: windows[ends[own.start] : ends[own.stop]])


def shard_of_epoch(stream: EpochWindows, number: int) -> Windows | Shard:
    """As `sharded`, of an epoch's chunks: each process reads its own."""
    chunks = stream.drawn(number)
    counts = [stream.counts[k] for k in chunks]
    return sharded(counts, lambda own: stream.windows(chunks[own.start : own.stop]))


class _Mean(torch.autograd.Function):
    """The mean over processes; its derivative is by this one's part, for gradients are averaged apart from it."""

    @staticmethod
    def forward(ctx: Any, part: torch.Tensor) -> torch.Tensor:
        return total(part) / count()

    @staticmethod
    def backward(ctx: Any, *slopes: torch.Tensor) -> torch.Tensor:
        return slopes[0]


class _Loss(torch.nn.Module):
    def __init__(self, model: torch.nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(self, loss: PartLoss, part: Shard) -> torch.Tensor:
        try:
            return part.share * count() * loss(part.windows, lambda mean: total(part.share * mean))
        except torch.linalg.LinAlgError:  # the others wait for a gradient
            return torch.stack([x.sum() for x in self.model.parameters()]).sum() * torch.nan


class Together:
    """The loss of windows over all processes, with its gradient, from each one's part."""

    def __init__(self, model: torch.nn.Module) -> None:
        self._parallel: Any = (
            DistributedDataParallel(_Loss(model), find_unused_parameters=True) if count() > 1 else None
        )

    def __call__(self, loss: PartLoss, windows: Any) -> torch.Tensor:
        """The mean ``loss`` of windows that are not shared, or over the shards of all processes."""
        if not isinstance(windows, Shard):
            return loss(windows, lambda mean: mean)
        mean: torch.Tensor = _Mean.apply(self._parallel(loss, windows))
        return mean
