"""Logs larger than memory, for torque fits: one pass to know them, then chunk by chunk, and windows to validate on."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from spelgen.errors import Diagnostic, LogError, collect
from spelgen.fitting.dataset import (
    DEFAULT_CHOICE,
    TUNING,
    TrainingData,
    WindowChoice,
    WindowCutting,
    numbers_of,
)
from spelgen.fitting.rollout import loss_scales
from spelgen.logs.checks import LogChecks
from spelgen.logs.chunks import Chunk, scan
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import GAP, gap_ends
from spelgen.logs.windows import Windows, joined, thinned
from spelgen.settings.log_mapping import LogMapping


@dataclass(frozen=True)
class LargeLogs:
    """Parquet files of which one chunk at a time is in memory; what `large_files` found. gap: see `Preprocessing`."""

    files: tuple[Path, ...]
    joints: tuple[str, ...]
    joint_types: tuple[str, ...]
    mapping: LogMapping | None = None
    gap: float = GAP

    @cached_property
    def contents(self) -> LogContents:
        """What a pass over the files tells. Raises LogError, and SettingsError where the mapping does not fit."""
        return _read_once(self)


@dataclass(frozen=True, eq=False)
class LogContents:
    """Hold what one pass finds.

    pieces: lengths of the gap-free pieces of each chunk. rates: of chunks that are long enough [Hz].
    """

    chunks: list[Chunk]
    rates: list[float]
    notes: list[Diagnostic]
    digest: str
    pieces: list[list[int]]


def prepare_streamed(
    logs: LargeLogs, preprocessing: Preprocessing, choice: WindowChoice = DEFAULT_CHOICE
) -> TrainingData:
    """As `prepare_data`; whole chunks (see `scan`) are set aside for validation, and windows are only a sample."""
    if logs.gap != preprocessing.gap:
        logs = replace(logs, gap=preprocessing.gap)
    contents = logs.contents
    resolved = preprocessing.resolved(contents.rates)
    cutting = WindowCutting(choice, resolved)
    counts = [sum(map(cutting.count, pieces)) for pieces in contents.pieces]
    usable = np.flatnonzero(counts).tolist()
    chosen = _split(usable, cutting, choice)
    training, validating = (list(map(contents.chunks.__getitem__, numbers)) for numbers in chosen)
    windows = _sample(training, cutting)
    message = (
        f"larger than memory: read in {len(contents.chunks)} chunks; validation on {len(validating)} chunks, "
        f"{len(contents.chunks) - len(usable)} have no window"
    )
    return TrainingData(
        training=windows,
        validation=_sample(validating, cutting),
        size=int(np.take(counts, chosen[0]).sum()),
        scales=loss_scales(windows, logs.joint_types),
        preprocessing=resolved,
        training_names=tuple(chunk.name for chunk in training),
        validation_names=tuple(chunk.name for chunk in validating),
        diagnostics=(
            *contents.notes,
            *resolved.diagnostics,
            Diagnostic("info", "streamed", "logs", None, message),
        ),
        digest=contents.digest,
        chunks=tuple(contents.chunks),
    )


def _split(
    usable: Sequence[int], cutting: WindowCutting, choice: WindowChoice
) -> tuple[list[int], list[int]]:
    """Return which chunks are for training and which for validation; chunks without a window are left out."""
    if len(usable) < 2:
        raise LogError(f"no two chunks with {cutting.shortest} samples without a gap", expected="several")
    assert isinstance(choice.validation, float)
    size = min(max(1, round(choice.validation * len(usable))), len(usable) - 1)
    validated = set(np.random.default_rng(choice.seed).permutation(usable)[:size].tolist())
    return [k for k in usable if k not in validated], sorted(validated)


def _sample(chunks: Sequence[Chunk], cutting: WindowCutting) -> Windows:
    """Return some windows, evenly spread over some chunks, which are evenly spread themselves."""
    chosen = chunks[:: -(-len(chunks) // TUNING.chunks)]
    samples = []
    for chunk in chosen:
        windows = thinned(cutting.windows([chunk.load()]), max(1, TUNING.windows // len(chosen)))
        samples.append(joined([windows]))  # a copy: a slice would keep all windows of its chunk
    return joined(samples)


def _read_once(logs: LargeLogs) -> LogContents:
    chunks: list[Chunk] = []
    pieces: list[list[int]] = []
    rates: list[float] = []
    checks = LogChecks(logs.joints, logs.joint_types)
    numbers = hashlib.sha256()
    for chunk, trajectory in scan(logs.files, logs.joints, logs.mapping, logs.joint_types):
        chunks.append(chunk)
        pieces.append(np.diff(gap_ends(trajectory.t, logs.gap)).tolist())
        rates.append(trajectory.sample_rate)
        checks.add(trajectory)
        for array in numbers_of(trajectory):
            numbers.update(array)
    summary = checks.findings()
    collect(summary.errors)
    # the last samples of a recording may be a chunk of their own, too short to tell a rate
    lengths = np.array(list(map(sum, pieces)))
    reliable = np.array(rates)[lengths > lengths.max() / 10].tolist()
    return LogContents(chunks, reliable, summary.notes, numbers.hexdigest(), pieces)
