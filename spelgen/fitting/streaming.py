"""Training data from logs larger than memory: one pass to know them, samples to measure on, a stream to learn from."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spelgen.errors import Diagnostic, LogError
from spelgen.fitting.dataset import (
    LARGEST_VALIDATION,
    TrainingConfig,
    TrainingData,
    filter_cutoff,
    filter_note,
)
from spelgen.fitting.rollout import loss_scales
from spelgen.logs.checks import Doubt, doubts, tell, told_gaps
from spelgen.logs.chunks import Part, scan
from spelgen.logs.epoch_windows import Cutting, WindowStream
from spelgen.logs.filtering import automatic_spacing
from spelgen.logs.mapping import LogMapping
from spelgen.logs.trajectory import gap_ends, rate

SAMPLED = 2**16  # windows on which scales and substeps are chosen, and of the momentum steps
SAMPLED_PARTS = 32  # that these windows come from
VALIDATED_PARTS = 16


@dataclass(frozen=True, eq=False)
class _Known:
    """What one pass over the logs tells. pieces: lengths of the gap-free pieces of each part. rates: of parts
    that are long enough [Hz].
    """

    parts: list[Part]
    pieces: list[list[int]]
    rates: list[float]
    notes: list[Diagnostic]
    digest: str


def prepare_streamed(
    files: Sequence[Path],
    joints: Sequence[str],
    joint_types: Sequence[str],
    config: TrainingConfig,
    mapping: LogMapping | None = None,
) -> TrainingData:
    """As `prepare_data`, from Parquet files of which one part at a time is in memory.

    Whole parts (see `scan`) are set aside for validation. Raises LogError, and SettingsError where the mapping
    does not fit.
    """
    known = _read_once(files, joints, joint_types, mapping)
    cutoff = filter_cutoff(config.filter, known.rates)
    every = config.every or automatic_spacing(known.rates, cutoff)
    cutting = Cutting(config.window, config.stride, every, cutoff)
    training, validation = _split(known, cutting, config)
    sample = training.sample(SAMPLED_PARTS, SAMPLED)
    unused = len(known.parts) - len(training.parts) - len(validation.parts)
    message = (
        f"larger than memory: read in {len(known.parts)} parts, {training.shares} epochs pass over all; "
        f"validation on {len(validation.parts)} parts, {unused} hold no window"
    )
    note = Diagnostic("info", "streamed", "logs", None, message)
    return TrainingData(
        training=sample,
        validation=validation.sample(VALIDATED_PARTS, LARGEST_VALIDATION),
        scales=loss_scales(sample, joint_types),
        cutoff=cutoff,
        training_names=tuple(part.name for part in training.parts),
        validation_names=tuple(part.name for part in validation.parts),
        diagnostics=(*known.notes, *filter_note(cutoff), note),
        digest=known.digest,
        stream=training,
    )


def _split(known: _Known, cutting: Cutting, config: TrainingConfig) -> tuple[WindowStream, WindowStream]:
    """Training and validation, which share no part; parts without a window are left out."""
    counts = [sum(map(cutting.count, pieces)) for pieces in known.pieces]
    usable = [index for index, count in enumerate(counts) if count]
    if len(usable) < 2:
        raise LogError(f"no two parts with {cutting.shortest} samples without a gap", expected="several")
    size = min(max(1, round(config.validation_fraction * len(usable))), len(usable) - 1)
    validated = set(np.random.default_rng(config.seed).permutation(usable)[:size].tolist())

    def stream(chosen: list[int]) -> WindowStream:
        parts = tuple(known.parts[index] for index in chosen)
        return WindowStream(parts, tuple(counts[index] for index in chosen), cutting, config.seed)

    return (
        stream([index for index in usable if index not in validated]),
        stream([index for index in usable if index in validated]),
    )


def _read_once(
    files: Sequence[Path], joints: Sequence[str], joint_types: Sequence[str], mapping: LogMapping | None
) -> _Known:
    parts: list[Part] = []
    pieces: list[list[int]] = []
    rates: list[float] = []
    lengths: list[int] = []
    found: list[Doubt] = []
    gaps: list[Diagnostic] = []
    numbers = hashlib.sha256()
    for part, trajectory in scan(files, joints, mapping, joint_types):
        parts.append(part)
        pieces.append(np.diff(gap_ends(trajectory.t)).tolist())
        lengths.append(len(trajectory.t))
        rates.append(rate(trajectory))
        found += doubts(trajectory, joints, joint_types)
        gaps += told_gaps(trajectory)
        for array in (trajectory.t, trajectory.q, trajectory.qd, trajectory.tau):
            numbers.update(array.tobytes())
    notes = [*gaps[:1], *tell(found, joints, len(parts))]
    # the last samples of a recording may be a part of their own, too short to tell a rate
    told = [each for each, length in zip(rates, lengths, strict=True) if length > max(lengths) / 10]
    return _Known(parts, pieces, told, notes, numbers.hexdigest())
