"""Stream Parquet logs larger than memory: once from end to end, then chunk by chunk, any of them at any time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.parquet

from spelgen.errors import LogError, SpelgenError, collect
from spelgen.logs.arm_mapping import GivenMapping, LoggedArm, log_source
from spelgen.logs.log_files import log_files
from spelgen.logs.parquet_files import PARQUET
from spelgen.logs.read import ROW_GROUP, read_logs
from spelgen.logs.tables import Layout, reading, stored_columns, table_layout
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.values import clock_start, make_trajectory, require_increasing_times, values_in_si
from spelgen.settings.log_mapping import LogMapping
from spelgen.settings.tuning.logs import LogTuning

TUNING = LogTuning()
BUFFER = 2**16  # bytes read ahead of each column


@dataclass(frozen=True)
class ParquetLog:
    """Say how a file is read. stored: columns that are needed. start: of its clock. stamp: of its last change."""

    file: Path
    layout: Layout
    stored: tuple[str, ...]
    start: int
    stamp: tuple[int, int]

    def values(self, batch: pa.RecordBatch, row: int) -> np.ndarray:
        """Return what a batch from this row on holds (T, C), in SI units."""
        return values_in_si(batch, self.layout, self.file, self.start, row)


@dataclass(frozen=True)
class Chunk:
    """Name a stretch of one recording, rows first..stop of a file; `load` reads it."""

    name: str
    log: ParquetLog
    first: int
    stop: int

    def load(self) -> Trajectory:
        """Return the chunk's samples, the same as `scan` gave. Raises LogError where the file has changed."""
        # rows of another file under the same name would be fitted without a word
        if _stamp(self.log.file) != self.log.stamp:
            raise LogError(
                "a file that has changed since it was first read", file=self.log.file, do="start a new run"
            )
        source = _source(self.log.file)
        groups, row = _row_groups(source, self.first, self.stop)
        stretches = []
        for batch in source.iter_batches(ROW_GROUP, row_groups=groups, columns=list(self.log.stored)):
            low, high = max(self.first - row, 0), min(self.stop - row, batch.num_rows)
            if low < high:
                stretches.append(self.log.values(batch.slice(low, high - low), row + low))
            row += batch.num_rows
            if row >= self.stop:
                break
        return self.trajectory(np.concatenate(stretches))

    def trajectory(self, data: np.ndarray) -> Trajectory:
        """Return its samples, from their values (T, C) in SI units."""
        return make_trajectory(data, self.log.layout, self.name, self.log.file)


class Recording(NamedTuple):
    """Name the rows of one recording in a file."""

    name: str
    first: int
    stop: int


def large_files(
    paths: Path | str | Iterable[Path | str], joints: Sequence[str], role: str | None = None
) -> list[Path]:
    """Return the Parquet files among the logs, where they are together larger than memory; else none.

    Raises LogError where logs of another format lie beside: only Parquet can be read in chunks.
    """
    errors: list[SpelgenError] = []
    files = log_files(paths, role, errors)
    collect(errors)
    parquet = [file for file in files if file.suffix in PARQUET.suffixes]
    rows = 0
    for file in parquet:
        with reading(file):
            rows += pa.parquet.read_metadata(file).num_rows
    # from metadata alone: to count by reading would take what streaming is to save
    numbers = rows * (1 + 3 * len(joints))
    if 8 * numbers <= TUNING.in_memory:
        return []
    for file in files:
        if file not in parquet:
            errors.append(
                LogError("a log beside others too large for memory", file=file, expected="Parquet like them")
            )
    collect(errors)
    return parquet


def stream_logs(
    paths: Path | str | Sequence[Path | str],
    arm: LoggedArm,
    mapping: GivenMapping = None,
    role: str | None = None,
) -> Iterator[Trajectory]:
    """Yield what `read_logs` gives; Parquet files larger than memory chunk by chunk."""
    source = log_source(arm, mapping)
    large = large_files(paths, source.joints, role)
    if not large:
        yield from read_logs(paths, arm, mapping, role)
        return
    for _, trajectory in scan(large, source.joints, source.mapping, source.joint_types):
        yield trajectory


def scan(
    files: Sequence[Path],
    joints: Sequence[str],
    mapping: LogMapping | None = None,
    joint_types: Sequence[str] | None = None,
) -> Iterator[tuple[Chunk, Trajectory]]:
    """Yield every chunk with its samples, read once in the files' order; the caller keeps what it needs of them.

    A longer recording is several chunks. Raises LogError and SettingsError as `read_logs` does.
    """
    mapping = mapping or LogMapping()
    collect(mapping.misfits(joints, joint_types))
    # names as `read_logs` gives them, though not all files are known when the first is read
    stems = Counter(file.stem for file in files)
    for file in files:
        log = _open_log(file, joints, mapping)
        stem = file.stem if stems[file.stem] == 1 else str(file)
        last = ("", -np.inf)  # recording and time of the last sample
        for chunk, recording, data in _chunks(log, stem, len(files) > 1):
            t = data[:, 0]
            # times must increase across the border between chunks, too
            if last[0] == recording:
                t = np.concatenate([[last[1]], t])
            rows = np.arange(chunk.stop - len(t), chunk.stop)
            require_increasing_times(t, rows, file, log.layout.columns[0])
            last = (recording, t[-1])
            yield chunk, chunk.trajectory(data)


def _open_log(file: Path, joints: Sequence[str], mapping: LogMapping) -> ParquetLog:
    stamp = _stamp(file)
    with reading(file):
        source = _source(file)
    names = source.schema_arrow.names
    layout = table_layout(source.schema_arrow, joints, mapping, file)
    stored = stored_columns(replace(layout, labels=None), names)
    head = next(source.iter_batches(1, columns=[layout.columns[0]]), None)
    if head is None:
        raise LogError("no rows", file=file, expected="at least one window of samples")
    return ParquetLog(file, layout, tuple(stored), clock_start(head.column(0)), stamp)


def _chunks(log: ParquetLog, stem: str, several_files: bool) -> Iterator[tuple[Chunk, str, np.ndarray]]:
    """Yield each chunk of a file with the name of its recording and its values."""
    batches = _source(log.file).iter_batches(ROW_GROUP, columns=list(log.stored))
    # values that were read and belong to no chunk yet, from row `first` on
    pending, first = np.zeros((0, len(log.layout.columns))), 0
    for recording in _recordings(log, stem, several_files):
        for name, start, stop in _cut(recording):
            while first + len(pending) < stop:
                pending, first = pending[start - first :], start
                batch = next(batches)
                pending = np.concatenate([pending, log.values(batch, first + len(pending))])
            yield Chunk(name, log, start, stop), recording.name, pending[start - first : stop - first]


def _cut(recording: Recording) -> Iterator[Recording]:
    """Yield the chunks of a recording, numbered where there are several."""
    size = TUNING.chunk_samples
    for number, first in enumerate(range(recording.first, recording.stop, size), start=1):
        name = recording.name
        if recording.stop - recording.first > size:
            name = f"{name} [{number}]"
        yield Recording(name, first, min(first + size, recording.stop))


def _recordings(log: ParquetLog, stem: str, several_files: bool) -> list[Recording]:
    """Return each recording of a file. Raises LogError where the rows of one do not lie together."""
    if log.layout.labels is None:
        return [Recording(stem, 0, _source(log.file).metadata.num_rows)]
    recordings: list[Recording] = []
    labels: set[str] = set()
    start = 0
    for label, stop in _label_runs(log):
        if label in labels:
            raise LogError(
                f"trajectory {label} once more, after others", file=log.file,
                element=f"row {start + 1}, column {log.layout.labels}",
                expected="its rows together, in a log too large for memory", do="sort the rows",
            )  # fmt: skip
        labels.add(label)
        recordings.append(Recording(f"{stem}/{label}" if several_files else label, start, stop))
        start = stop
    return recordings


def _label_runs(log: ParquetLog) -> list[tuple[str, int]]:
    """Return each run of equal labels, in the rows' order, with the row at which it ends."""
    runs: list[tuple[str, int]] = []
    row = 0
    for batch in _source(log.file).iter_batches(ROW_GROUP, columns=[log.layout.labels]):
        # runs, and not rows: a label repeats a million times
        encoded = pa.compute.run_end_encode(batch.column(0).cast(pa.string()))
        ends = encoded.run_ends.to_pylist()
        for value, end in zip(encoded.values.to_pylist(), ends, strict=True):
            label = str(value)
            if runs and runs[-1][0] == label:
                runs.pop()
            runs.append((label, row + end))
        row += batch.num_rows
    return runs


def _stamp(file: Path) -> tuple[int, int]:
    """Return when a file was last changed [ns], and its size."""
    status = file.stat()
    return status.st_mtime_ns, status.st_size


def _source(file: Path) -> pa.parquet.ParquetFile:
    """Open a file to be read page by page: by default pyarrow keeps all row groups, and a row group at once."""
    return pa.parquet.ParquetFile(file, pre_buffer=False, buffer_size=BUFFER)


def _row_groups(source: pa.parquet.ParquetFile, first: int, stop: int) -> tuple[list[int], int]:
    """Return the row groups that hold these rows, and the first row of the first group."""
    groups: list[int] = []
    start = first_row = 0
    for number in range(source.num_row_groups):
        end = start + source.metadata.row_group(number).num_rows
        if end > first and start < stop:
            if not groups:
                first_row = start
            groups.append(number)
        start = end
    return groups, first_row
