"""Parquet logs larger than memory: read once from end to end, then chunk by chunk, any of them at any time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.parquet

from spelgen.errors import LogError, SpelgenError, collect
from spelgen.logs.arm_mapping import GivenMapping, log_source
from spelgen.logs.log_files import log_files
from spelgen.logs.read import ROW_GROUP, read_logs
from spelgen.logs.tables import Layout, opened, stored_columns, table_layout
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.values import clock_start, made_trajectory, require_increasing_times, values_in_si
from spelgen.settings.log_mapping import LogMapping

IN_MEMORY = 100_000_000  # bytes of numbers up to which logs are held in memory; windows take five times that
BUFFER = 2**16  # bytes read ahead of each column
LONGEST = 2**16  # samples of a chunk: of 7 joints, 12 MB, and 53 MB as windows


@dataclass(frozen=True)
class ParquetLog:
    """A file and how it is read. stored: columns that are needed. start: of its clock. stamp: of its last change."""

    file: Path
    layout: Layout
    stored: tuple[str, ...]
    start: int
    stamp: tuple[int, int]

    def values(self, batch: pa.RecordBatch, row: int) -> np.ndarray:
        """What a batch from this row on holds (T, C), in SI units."""
        return values_in_si(batch, self.layout, self.file, self.start, row)


@dataclass(frozen=True)
class Chunk:
    """A stretch of one recording, rows first..stop of a file; `load` reads it."""

    name: str
    log: ParquetLog
    first: int
    stop: int

    def load(self) -> Trajectory:
        """The chunk's samples, the same as `scan` gave."""
        if _stamp(self.log.file) != self.log.stamp:
            raise LogError(
                "a file that has changed since it was first read", file=self.log.file, do="start a new run"
            )
        source = _source(self.log.file)
        groups, row = _row_groups(source, self.first, self.stop)
        found = []
        for batch in source.iter_batches(ROW_GROUP, row_groups=groups, columns=list(self.log.stored)):
            low, high = max(self.first - row, 0), min(self.stop - row, batch.num_rows)
            if low < high:
                found.append(self.log.values(batch.slice(low, high - low), row + low))
            row += batch.num_rows
            if row >= self.stop:
                break
        return self.trajectory(np.concatenate(found))

    def trajectory(self, data: np.ndarray) -> Trajectory:
        """Its samples, from their values (T, C) in SI units."""
        return made_trajectory(data, self.log.layout, name=self.name, file=self.log.file)


def large_files(
    paths: Path | str | Iterable[Path | str], joints: Sequence[str], role: str | None = None
) -> list[Path]:
    """The Parquet files among the logs, where they are together larger than IN_MEMORY; else none.

    Raises LogError where logs of another kind lie beside: only Parquet can be read in chunks.
    """
    errors: list[SpelgenError] = []
    files = log_files(paths, role, errors)
    collect(errors)
    parquet = [file for file in files if file.suffix == ".parquet"]
    rows = sum(opened(file, partial(pa.parquet.read_metadata, file)).num_rows for file in parquet)
    if rows * (1 + 3 * len(joints)) * 8 <= IN_MEMORY:
        return []
    collect([
        LogError("a log beside others too large for memory", file=file, expected="Parquet like them")
        for file in files if file not in parquet
    ])  # fmt: skip
    return parquet


def stream_logs(
    paths: Path | str | Sequence[Path | str], arm: Any, mapping: GivenMapping = None, role: str | None = None
) -> Iterator[Trajectory]:
    """What `read_logs` gives, one after another; Parquet files larger than memory chunk by chunk."""
    source = log_source(arm, mapping)
    large = large_files(paths, source.joints, role)
    if large:
        return (
            trajectory for _, trajectory in scan(large, source.joints, source.mapping, source.joint_types)
        )
    return iter(read_logs(paths, arm, mapping, role))


def scan(
    files: Sequence[Path],
    joints: Sequence[str],
    mapping: LogMapping | None = None,
    joint_types: Sequence[str] | None = None,
) -> Iterator[tuple[Chunk, Trajectory]]:
    """Every chunk with its samples, read once in the files' order; the caller keeps what it needs of them.

    A recording of more than LONGEST samples is several chunks. Raises LogError and SettingsError as `read_logs`
    does.
    """
    mapping = mapping or LogMapping()
    collect(mapping.misfits(joints, joint_types))
    stems = Counter(file.stem for file in files)
    for file in files:
        log = _opened_log(file, tuple(joints), mapping)
        place = file.stem if stems[file.stem] == 1 else str(file)
        before = ("", -np.inf)
        for chunk, recording, data in _chunks(log, place, len(files) > 1):
            t = data[:, 0]
            follows = before[0] == recording
            times = np.concatenate([[before[1]], t]) if follows else t
            rows = np.arange(chunk.stop - len(times), chunk.stop)
            require_increasing_times(times, rows, file, log.layout.columns[0])
            before = (recording, t[-1])
            yield chunk, chunk.trajectory(data)


def _opened_log(file: Path, joints: tuple[str, ...], mapping: LogMapping) -> ParquetLog:
    stamp = _stamp(file)
    source = opened(file, lambda: _source(file))
    schema = source.schema_arrow
    layout = table_layout(schema, joints, mapping, file)
    stored = stored_columns(replace(layout, labels=None), schema.names)
    head = next(source.iter_batches(1, columns=[layout.columns[0]]), None)
    if head is None:
        raise LogError("no rows", file=file, expected="at least one window of samples")
    return ParquetLog(file, layout, tuple(stored), clock_start(head.column(0)), stamp)


def _chunks(log: ParquetLog, place: str, several: bool) -> Iterator[tuple[Chunk, str, np.ndarray]]:
    """Each chunk of a file with the name of its recording and its values."""
    batches = _source(log.file).iter_batches(ROW_GROUP, columns=list(log.stored))
    held, first = (
        np.zeros((0, len(log.layout.columns))),
        0,
    )  # what was read and not yet given, from this row on
    for recording, start, end in _recordings(log, place, several):
        for name, begin, stop in _cut(recording, start, end):
            while first + len(held) < stop:
                held, first = held[begin - first :], begin
                held = np.concatenate([held, log.values(next(batches), first + len(held))])
            yield Chunk(name, log, begin, stop), recording, held[begin - first : stop - first]


def _cut(recording: str, start: int, end: int) -> Iterator[tuple[str, int, int]]:
    several = end - start > LONGEST
    for number, first in enumerate(range(start, end, LONGEST), start=1):
        name = f"{recording} [{number}]" if several else recording
        yield name, first, min(first + LONGEST, end)


def _recordings(log: ParquetLog, place: str, several: bool) -> list[tuple[str, int, int]]:
    """Name, first row and end of each recording of a file; the rows of one must lie together."""
    source = _source(log.file)
    if log.layout.labels is None:
        return [(place, 0, source.metadata.num_rows)]
    labels: list[str] = []
    ends: list[int] = []  # where the run of each label ends
    row = 0
    for batch in source.iter_batches(ROW_GROUP, columns=[log.layout.labels]):
        encoded = pa.compute.run_end_encode(batch.column(0).cast(pa.string()))
        for label, end in zip(
            map(str, encoded.values.to_pylist()), encoded.run_ends.to_pylist(), strict=True
        ):
            if labels and labels[-1] == label:
                ends[-1] = row + end
            else:
                labels.append(label)
                ends.append(row + end)
        row += batch.num_rows
    starts = [0, *ends][:-1]
    seen: set[str] = set()
    for label, start in zip(labels, starts, strict=True):
        if label in seen:
            raise LogError(
                f"trajectory {label} once more, after others", file=log.file,
                element=f"row {start + 1}, column {log.layout.labels}",
                expected="its rows together, in a log too large for memory", do="sort the rows",
            )  # fmt: skip
        seen.add(label)
    names = [f"{place}/{label}" if several else label for label in labels]
    return list(zip(names, starts, ends, strict=True))


def _stamp(file: Path) -> tuple[int, int]:
    """When a file was last changed [ns], and its size."""
    status = file.stat()
    return status.st_mtime_ns, status.st_size


def _source(file: Path) -> pa.parquet.ParquetFile:
    """A file that is read page by page: by default pyarrow keeps all row groups, and a row group at once."""
    return pa.parquet.ParquetFile(file, pre_buffer=False, buffer_size=BUFFER)


def _row_groups(source: pa.parquet.ParquetFile, first: int, stop: int) -> tuple[list[int], int]:
    """The row groups that hold these rows, and the first row of the first group."""
    sizes = [source.metadata.row_group(k).num_rows for k in range(source.num_row_groups)]
    ends = np.cumsum(sizes)
    groups = [k for k, end in enumerate(ends) if end > first and end - sizes[k] < stop]
    return groups, int(ends[groups[0]] - sizes[groups[0]])
