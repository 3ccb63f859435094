"""Logs larger than memory, for torque fits: one pass to know them, then chunk by chunk, and windows to validate on."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from spelgen.errors import Diagnostic, LogError, collect
from spelgen.fitting.dataset import DEFAULT_CHOICE, TUNING, TrainingData, WindowChoice, numbers_of
from spelgen.fitting.rollout import loss_scales
from spelgen.logs.checks import LogChecks
from spelgen.logs.chunks import Chunk, scan
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import GAP, gap_ends, set_aside
from spelgen.logs.windows import Windows, joined, thinned
from spelgen.settings.log_mapping import LogMapping


@dataclass(frozen=True, eq=False)
class LogContents:
    """Hold what one pass finds.

    longest: samples of the longest gap-free piece of each chunk. rates: of chunks that are long enough [Hz].
    """

    chunks: list[Chunk]
    longest: list[int]
    rates: list[float]
    notes: list[Diagnostic]
    digest: str


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
        chunks: list[Chunk] = []
        longest: list[int] = []
        lengths: list[int] = []
        rates: list[float] = []
        checks = LogChecks(self.joints, self.joint_types)
        numbers = hashlib.sha256()
        for chunk, trajectory in scan(self.files, self.joints, self.mapping, self.joint_types):
            chunks.append(chunk)
            longest.append(int(np.diff(gap_ends(trajectory.t, self.gap)).max()))
            lengths.append(len(trajectory))
            rates.append(trajectory.sample_rate)
            checks.add(trajectory)
            for array in numbers_of(trajectory):
                numbers.update(array)
        summary = checks.findings()
        collect(summary.errors)
        # the last samples of a recording may be a chunk of their own, too short to tell a rate
        reliable = np.array(rates)[np.array(lengths) > max(lengths) / 10].tolist()
        return LogContents(chunks, longest, reliable, summary.notes, numbers.hexdigest())


def prepare_streamed(
    logs: LargeLogs, preprocessing: Preprocessing, choice: WindowChoice = DEFAULT_CHOICE
) -> TrainingData:
    """As `prepare_data`; whole chunks (see `scan`) are set aside for validation, and windows are only a sample."""
    if logs.gap != preprocessing.gap:
        logs = replace(logs, gap=preprocessing.gap)
    contents = logs.contents
    resolved = preprocessing.resolved(contents.rates)
    span = choice.span(resolved)
    usable = [
        chunk for chunk, longest in zip(contents.chunks, contents.longest, strict=True) if longest >= span
    ]
    if len(usable) < 2:
        raise LogError(f"no two chunks with {span} samples without a gap", expected="several")
    assert isinstance(choice.validation, float)
    size = min(max(1, round(choice.validation * len(usable))), len(usable) - 1)
    order = np.random.default_rng(choice.seed).permutation(len(usable))
    training, validating = set_aside(usable, order[:size])
    windows = _sample(training, resolved, choice)
    message = (
        f"larger than memory: read in {len(contents.chunks)} chunks; validation on {len(validating)} chunks, "
        f"{len(contents.chunks) - len(usable)} have no window"
    )
    streamed = Diagnostic("info", "streamed", "logs", None, message)
    return TrainingData(
        training=windows,
        validation=_sample(validating, resolved, choice),
        scales=loss_scales(windows, logs.joint_types),
        preprocessing=resolved,
        training_names=tuple(chunk.name for chunk in training),
        validation_names=tuple(chunk.name for chunk in validating),
        diagnostics=(*contents.notes, *resolved.diagnostics, streamed),
        digest=contents.digest,
        chunks=contents.chunks,
    )


def _sample(chunks: Sequence[Chunk], preprocessing: Preprocessing, choice: WindowChoice) -> Windows:
    """Return some windows, evenly spread over some chunks, which are evenly spread themselves."""
    chosen = chunks[:: -(-len(chunks) // TUNING.chunks)]
    samples = []
    for chunk in chosen:
        windows = choice.windows([chunk.load()], preprocessing)
        # a copy: a slice would keep all windows of its chunk
        samples.append(joined([thinned(windows, max(1, TUNING.windows // len(chosen)))]))
    return joined(samples)
