"""Logs larger than memory: one pass to know them, samples to measure on, a stream of windows to fit."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from spelgen.dynamics.bristles import BristleReach
from spelgen.errors import Diagnostic, LogError, collect
from spelgen.fitting.dataset import LARGEST_VALIDATION, TrainingData
from spelgen.fitting.rollout import loss_scales
from spelgen.logs.checks import Finding, findings, gap_diagnostics, summarised
from spelgen.logs.chunks import Chunk, scan
from spelgen.logs.epoch_windows import EpochWindows, WindowCutting
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import GAP, gap_ends
from spelgen.settings.log_mapping import LogMapping

if TYPE_CHECKING:
    from spelgen.settings.fits import WindowConfig

SAMPLED = 2**16  # windows on which scales and substeps are chosen, and of the momentum steps
SAMPLED_CHUNKS = 32  # that these windows come from
VALIDATED_CHUNKS = 16


@dataclass(frozen=True)
class LargeLogs:
    """Parquet files of which one chunk at a time is in memory; what `large_files` found. gap: see `Preprocessing`."""

    files: tuple[Path, ...]
    joints: tuple[str, ...]
    joint_types: tuple[str, ...]
    mapping: LogMapping | None = None
    gap: float = GAP

    @cached_property
    def known(self) -> KnownLogs:
        """What a pass over the files tells. Raises LogError, and SettingsError where the mapping does not fit."""
        return _read_once(self)

    @property
    def rates(self) -> list[float]:
        """Sample rates [Hz]."""
        return self.known.rates


@dataclass(frozen=True, eq=False)
class KnownLogs:
    """What one pass tells. pieces: lengths of the gap-free pieces of each chunk. rates: of chunks that are long
    enough [Hz].
    """

    chunks: list[Chunk]
    rates: list[float]
    notes: list[Diagnostic]
    digest: str
    pieces: list[list[int]]


def prepare_streamed(
    logs: LargeLogs,
    config: WindowConfig,
    preprocessing: Preprocessing,
    validation: float = 0.25,
    seed: int = 0,
    reach: BristleReach | None = None,
) -> TrainingData:
    """As `prepare_data`; whole chunks (see `scan`) are set aside for validation."""
    if logs.gap != preprocessing.gap:
        logs = replace(logs, gap=preprocessing.gap)
    known = logs.known
    resolved = preprocessing.resolved(known.rates)
    cutting = WindowCutting(config.window, config.stride, resolved, reach)
    training, validating = _split(known, cutting, validation, seed)
    sample = training.sample(SAMPLED_CHUNKS, SAMPLED)
    unused = len(known.chunks) - len(training.chunks) - len(validating.chunks)
    message = (
        f"larger than memory: read in {len(known.chunks)} chunks, {training.epochs_per_pass} epochs pass over all; "
        f"validation on {len(validating.chunks)} chunks, {unused} hold no window"
    )
    note = Diagnostic("info", "streamed", "logs", None, message)
    return TrainingData(
        training=sample,
        validation=validating.sample(VALIDATED_CHUNKS, LARGEST_VALIDATION),
        scales=loss_scales(sample, logs.joint_types),
        preprocessing=resolved,
        training_names=tuple(chunk.name for chunk in training.chunks),
        validation_names=tuple(chunk.name for chunk in validating.chunks),
        diagnostics=(*known.notes, *resolved.diagnostics, note),
        digest=known.digest,
        chunks=tuple(known.chunks),
        stream=training,
    )


def _split(
    known: KnownLogs, cutting: WindowCutting, fraction: float, seed: int
) -> tuple[EpochWindows, EpochWindows]:
    """Training and validation, which share no chunk; chunks without a window are left out."""
    counts = [sum(map(cutting.count, pieces)) for pieces in known.pieces]
    usable = [index for index, count in enumerate(counts) if count]
    if len(usable) < 2:
        raise LogError(f"no two chunks with {cutting.shortest} samples without a gap", expected="several")
    size = min(max(1, round(fraction * len(usable))), len(usable) - 1)
    validated = set(np.random.default_rng(seed).permutation(usable)[:size].tolist())

    def stream(chosen: list[int]) -> EpochWindows:
        chunks = tuple(known.chunks[index] for index in chosen)
        return EpochWindows(chunks, tuple(counts[index] for index in chosen), cutting, seed)

    return (
        stream([index for index in usable if index not in validated]),
        stream([index for index in usable if index in validated]),
    )


def _read_once(logs: LargeLogs) -> KnownLogs:
    chunks: list[Chunk] = []
    pieces: list[list[int]] = []
    rates: list[float] = []
    lengths: list[int] = []
    found: list[Finding] = []
    gaps: list[Diagnostic] = []
    numbers = hashlib.sha256()
    for chunk, trajectory in scan(logs.files, logs.joints, logs.mapping, logs.joint_types):
        chunks.append(chunk)
        pieces.append(np.diff(gap_ends(trajectory.t, logs.gap)).tolist())
        lengths.append(len(trajectory.t))
        rates.append(trajectory.sample_rate)
        found += findings(trajectory, logs.joints, logs.joint_types)
        gaps += gap_diagnostics(trajectory)
        for array in (trajectory.t, trajectory.q, trajectory.qd, trajectory.tau):
            numbers.update(np.ascontiguousarray(array).data)
    notes, errors = summarised(found, logs.joints, len(chunks))
    collect(errors)
    # the last samples of a recording may be a chunk of their own, too short to tell a rate
    told = [each for each, length in zip(rates, lengths, strict=True) if length > max(lengths) / 10]
    return KnownLogs(chunks, told, [*gaps[:1], *notes], numbers.hexdigest(), pieces)
