"""Parquet logs larger than memory: read once from end to end, then by parts, any of them at any time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.parquet

from spelgen.errors import LogError, SpelgenError, collect
from spelgen.logs.mapping import TIMES, LogMapping
from spelgen.logs.read import (
    ROW_GROUP,
    clock_start,
    in_si,
    log_files,
    require_increasing_times,
    table_values,
)
from spelgen.logs.tables import (
    UNITS_KEY,
    LogTable,
    labels_among,
    opened,
    read_schema,
    require_columns,
    wanted_names,
)
from spelgen.logs.trajectory import Trajectory

IN_MEMORY = 100_000_000  # bytes of numbers up to which logs are held in memory; windows take five times that
BUFFER = 2**16  # bytes read ahead of each column
LONGEST = 2**16  # samples of a part: of 7 joints, 12 MB, and 53 MB as windows


@dataclass(frozen=True)
class ParquetLog:
    """A file and how it is read. labels: the column of its recordings' names. start: of its clock."""

    file: Path
    joints: tuple[str, ...]
    mapping: LogMapping
    columns: tuple[str, ...]
    labels: str | None
    declares_units: bool
    start: int


@dataclass(frozen=True)
class Part:
    """A stretch of one recording, rows first..stop of a file; `load` reads it."""

    name: str
    log: ParquetLog
    first: int
    stop: int

    def load(self) -> Trajectory:
        """The part's samples, the same as `scan` gave."""
        source = _source(self.log.file)
        groups, row = _row_groups(source, self.first, self.stop)
        found = []
        for batch in source.iter_batches(ROW_GROUP, row_groups=groups, columns=list(self.log.columns)):
            low, high = max(self.first - row, 0), min(self.stop - row, batch.num_rows)
            if low < high:
                found.append(_values(batch.slice(low, high - low), self.log, row + low))
            row += batch.num_rows
            if row >= self.stop:
                break
        return _trajectory(self, np.concatenate(found))


def large_files(paths: Iterable[Path | str], joints: Sequence[str], role: str | None = None) -> list[Path]:
    """The Parquet files among the logs, where they are together larger than IN_MEMORY; else none.

    Raises LogError where logs of another kind lie beside: only Parquet can be read by parts.
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


def scan(
    files: Sequence[Path],
    joints: Sequence[str],
    mapping: LogMapping | None = None,
    joint_types: Sequence[str] | None = None,
) -> Iterator[tuple[Part, Trajectory]]:
    """Every part with its samples, read once in the files' order; the caller keeps what it needs of them.

    A recording of more than LONGEST samples is several parts. Raises LogError and SettingsError as `read_logs`
    does.
    """
    mapping = mapping or LogMapping()
    collect(mapping.misfits(joints, joint_types))
    stems = [file.stem for file in files]
    for file in files:
        log = _opened_log(file, tuple(joints), mapping)
        place = file.stem if stems.count(file.stem) == 1 else str(file)
        before = ("", -np.inf)
        for part, recording, values in _stretches(log, place, len(files) > 1):
            t = values[:, 0] * TIMES[log.mapping.units.t]
            follows = before[0] == recording
            times = np.concatenate([[before[1]], t]) if follows else t
            rows = np.arange(part.stop - len(times), part.stop)
            require_increasing_times(times, rows, file, log.columns[0])
            before = (recording, t[-1])
            yield part, _trajectory(part, values)


def _opened_log(file: Path, joints: tuple[str, ...], mapping: LogMapping) -> ParquetLog:
    schema, mapping = read_schema(file, mapping)
    columns = wanted_names(joints, mapping)
    require_columns(schema.names, columns, file, mapping)
    head = next(_source(file).iter_batches(1, columns=[columns[0]]), None)
    if head is None:
        raise LogError("no rows", file=file, expected="at least one window of samples")
    declared = UNITS_KEY in (schema.metadata or {}) or all(mapping.unit("q", joint) for joint in joints)
    start = clock_start(LogTable(None, pa.Table.from_batches([head]), columns, mapping))
    return ParquetLog(file, joints, mapping, columns, labels_among(schema.names, mapping), declared, start)


def _stretches(log: ParquetLog, place: str, several: bool) -> Iterator[tuple[Part, str, np.ndarray]]:
    """Each part of a file with the name of its recording and its values as logged."""
    parts = [
        (Part(name, log, first, stop), recording)
        for recording, start, end in _recordings(log, place, several)
        for name, first, stop in _cut(recording, start, end)
    ]
    batches = _source(log.file).iter_batches(ROW_GROUP, columns=list(log.columns))
    held, row = np.zeros((0, len(log.columns))), 0  # what was read and not yet given, and its first row
    for part, recording in parts:
        while row + len(held) < part.stop:
            batch = next(batches)
            held = np.concatenate([held, _values(batch, log, row + len(held))])
        size = part.stop - part.first
        yield part, recording, held[:size]
        held, row = held[size:].copy(), part.stop


def _cut(recording: str, start: int, end: int) -> Iterator[tuple[str, int, int]]:
    several = end - start > LONGEST
    for number, first in enumerate(range(start, end, LONGEST), start=1):
        name = f"{recording} [{number}]" if several else recording
        yield name, first, min(first + LONGEST, end)


def _recordings(log: ParquetLog, place: str, several: bool) -> list[tuple[str, int, int]]:
    """Name, first row and end of each recording of a file; the rows of one must lie together."""
    source = _source(log.file)
    if log.labels is None:
        return [(place, 0, source.metadata.num_rows)]
    runs: list[tuple[str, int]] = []  # a label and where its run ends
    row = 0
    for batch in source.iter_batches(ROW_GROUP, columns=[log.labels]):
        encoded = pa.compute.run_end_encode(batch.column(0).cast(pa.string()))
        for label, end in zip(encoded.values.to_pylist(), encoded.run_ends.to_pylist(), strict=True):
            if runs and runs[-1][0] == str(label):
                runs.pop()
            runs.append((str(label), row + end))
        row += batch.num_rows
    labels = [label for label, _ in runs]
    again = next((k for k, label in enumerate(labels) if label in labels[:k]), None)
    if again is not None:
        raise LogError(
            f"trajectory {labels[again]} once more, after others", file=log.file,
            element=f"row {runs[again - 1][1] + 1}, column {log.labels}",
            expected="its rows together, in a log too large for memory", do="sort the rows",
        )  # fmt: skip
    starts = [0, *(end for _, end in runs)]
    names = [f"{place}/{label}" if several else label for label in labels]
    return [(name, start, end) for name, start, (_, end) in zip(names, starts, runs, strict=False)]


def _source(file: Path) -> pa.parquet.ParquetFile:
    """A file that is read page by page: by default pyarrow keeps all row groups, and a row group at once."""
    return pa.parquet.ParquetFile(file, pre_buffer=False, buffer_size=BUFFER)


def _row_groups(source: pa.parquet.ParquetFile, first: int, stop: int) -> tuple[list[int], int]:
    """The row groups that hold these rows, and the first row of the first group."""
    sizes = [source.metadata.row_group(k).num_rows for k in range(source.num_row_groups)]
    ends = np.cumsum(sizes)
    groups = [k for k, end in enumerate(ends) if end > first and end - sizes[k] < stop]
    return groups, int(ends[groups[0]] - sizes[groups[0]])


def _values(batch: pa.RecordBatch, log: ParquetLog, row: int) -> np.ndarray:
    table = LogTable(None, pa.Table.from_batches([batch]), log.columns, log.mapping)
    return table_values(table, log.file, log.start, row)


def _trajectory(part: Part, values: np.ndarray) -> Trajectory:
    log = part.log
    t = values[:, 0] * TIMES[log.mapping.units.t]
    found = in_si(t, values[:, 1:], log.joints, log.mapping)
    return replace(found, name=part.name, file=log.file, declares_units=log.declares_units)
