"""Read Parquet logs larger than memory chunk by chunk, any of them at any time."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.parquet

from spelgen.errors import LogError, collect
from spelgen.logs.arm_mapping import GivenMapping, LoggedArm, log_source
from spelgen.logs.formats import log_files
from spelgen.logs.parquet_files import PARQUET
from spelgen.logs.read import read_logs
from spelgen.logs.recording import make_trajectory, require_increasing_times
from spelgen.logs.tables import Layout, reading, stored_columns, table_layout
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.tuning import TUNING
from spelgen.logs.values import clock_start, values_in_si
from spelgen.settings.log_mapping import LogMapping


@dataclass(frozen=True)
class Chunk:
    """Name a stretch of one recording, rows first..stop of a file; `load` reads it.

    stored: columns that are needed. start: of the file's clock. stamp: of its last change.
    """

    name: str
    layout: Layout
    stored: list[str]
    start: pa.Scalar | None
    stamp: tuple[int, int]
    first: int
    stop: int

    def load(self) -> Trajectory:
        """Return the chunk's samples. Raises LogError where the file has changed, or times do not increase."""
        file = self.layout.file
        # rows of another file under the same name would be fitted without a word
        if _stamp(file) != self.stamp:
            raise LogError("a file that has changed since it was first read", file=file, do="start a new run")
        source = _opened(file)
        starts = [0]
        for group in range(source.num_row_groups):
            starts.append(starts[-1] + source.metadata.row_group(group).num_rows)
        groups = range(bisect_right(starts, self.first) - 1, bisect_left(starts, self.stop))
        row = starts[groups[0]]
        stretches = []
        for batch in source.iter_batches(TUNING.chunk_samples, row_groups=list(groups), columns=self.stored):
            low, high = max(self.first - row, 0), min(self.stop - row, batch.num_rows)
            if low < high:
                rows = batch.slice(low, high - low)
                stretches.append(values_in_si(rows, self.layout, self.start, row + low))
            row += batch.num_rows
            if row >= self.stop:
                break
        data = np.concatenate(stretches)
        require_increasing_times(data[:, 0], range(self.first, self.stop), self.layout)
        return make_trajectory(data, self.layout, self.name)


def large_files(
    paths: Path | str | Iterable[Path | str], joints: Sequence[str], role: str | None = None
) -> list[Path]:
    """Return the Parquet files among the logs, where they are together larger than memory; else none.

    Raises LogError where logs of another format lie beside: only Parquet can be read in chunks.
    """
    files, errors = log_files(paths, role)
    collect(errors)
    parquet = [file for file in files if file.suffix in PARQUET.suffixes]
    rows = 0
    for file in parquet:
        with reading(file):
            rows += pa.parquet.read_metadata(file).num_rows
    # from metadata alone: to count by reading would take what streaming is to save
    if 8 * rows * (1 + 3 * len(joints)) <= TUNING.in_memory:
        return []
    for file in files:
        if file not in parquet:
            got = "a log beside others too large for memory"
            errors.append(LogError(got, file=file, expected="Parquet like them"))
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
    for _, trajectory in scan(large, source.joints, source.mapping, source.joint_types):
        yield trajectory


def scan(
    files: Sequence[Path],
    joints: Sequence[str],
    mapping: LogMapping | None = None,
    joint_types: Sequence[str] | None = None,
) -> Iterator[tuple[Chunk, Trajectory]]:
    """Yield every chunk with its samples, in the files' order; the caller keeps what it needs of them.

    A longer recording is several chunks. Raises LogError and SettingsError as `read_logs` does.
    """
    mapping = mapping or LogMapping()
    collect(mapping.misfits(joints, joint_types))
    # names as `read_logs` gives them, though not all files are known when the first is read
    stems = Counter(file.stem for file in files)
    for file in files:
        uncut = _uncut_file(file, joints, mapping)
        if stems[file.stem] > 1:
            uncut = replace(uncut, name=str(file))
        for recording in _recordings(uncut, len(files) > 1):
            latest = -np.inf
            starts = range(recording.first, recording.stop, TUNING.chunk_samples)
            for number, first in enumerate(starts, start=1):
                name = f"{recording.name} [{number}]" if len(starts) > 1 else recording.name
                stop = min(first + TUNING.chunk_samples, recording.stop)
                chunk = replace(recording, name=name, first=first, stop=stop)
                trajectory = chunk.load()
                # times must increase across the border between chunks, too
                border = np.array([latest, trajectory.t[0]])
                require_increasing_times(border, (first - 1, first), chunk.layout)
                latest = trajectory.t[-1]
                yield chunk, trajectory


def _uncut_file(file: Path, joints: Sequence[str], mapping: LogMapping) -> Chunk:
    stamp = _stamp(file)
    with reading(file):
        source = _opened(file)
    layout = table_layout(source.schema_arrow, joints, mapping, file)
    stored = stored_columns(replace(layout, labels=None), source.schema_arrow.names)
    head = next(source.iter_batches(1, columns=stored), None)
    if head is None:
        raise LogError("no rows", file=file, expected="at least one window of samples")
    rows = source.metadata.num_rows
    return Chunk(file.stem, layout, stored, clock_start(head, layout), stamp, 0, rows)


def _recordings(uncut: Chunk, several_files: bool) -> list[Chunk]:
    """Return each recording of a file, uncut. Raises LogError where the rows of one do not lie together."""
    column = uncut.layout.labels
    if column is None:
        return [uncut]
    stops: dict[str, int] = {}
    latest, first_row, stop = None, 0, 0
    for batch in _opened(uncut.layout.file).iter_batches(TUNING.chunk_samples, columns=[column]):
        # runs, and not rows: a label repeats a million times
        runs = pa.compute.run_end_encode(batch.column(0).cast(pa.string()))
        for value, end in zip(runs.values.to_pylist(), runs.run_ends.to_pylist(), strict=True):
            label = str(value)
            if label != latest and label in stops:
                got, do = f"trajectory {label} once more, after others", "sort the rows"
                expected = "its rows together, in a log too large for memory"
                raise uncut.layout.row_error(got, stop, column, expected, do)
            latest, stop = label, first_row + end
            stops[label] = stop
        first_row += batch.num_rows
    recordings = []
    for (label, stop), first in zip(stops.items(), [0, *stops.values()], strict=False):
        name = f"{uncut.name}/{label}" if several_files else label
        recordings.append(replace(uncut, name=name, first=first, stop=stop))
    return recordings


def _stamp(file: Path) -> tuple[int, int]:
    """Return when a file was last changed [ns], and its size."""
    status = file.stat()
    return status.st_mtime_ns, status.st_size


def _opened(file: Path) -> pa.parquet.ParquetFile:
    """Open a file to be read page by page: by default pyarrow keeps all row groups, and a row group at once."""
    return pa.parquet.ParquetFile(file, pre_buffer=False, buffer_size=2**16)
