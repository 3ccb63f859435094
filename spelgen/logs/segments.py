"""Collector of recordings from log tables: all rows, or evenly spread segments if the rows exceed a limit of memory."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import groupby
from math import inf
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from spelgen.errors import LogError
from spelgen.logs.recording import make_trajectory
from spelgen.logs.tables import Layout
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.tuning import TUNING
from spelgen.logs.values import clock_start, values_in_si

Piece = tuple[int, str, np.ndarray]
"""Number and name of a recording, and the row numbers (T,) of a part of the recording."""


class Segment(NamedTuple):
    """Consecutive rows of one recording.

    Attributes:
        recording: number of the recording among all recordings.
        name: name of the recording.
        layout: columns of the file, with their units.
        rows: (T,) row numbers in the file, from 0.
        values: (T, C) values of the C columns of the layout, in SI units.
        start: logged time [s] that was subtracted from the times in `values`.
    """

    recording: int
    name: str
    layout: Layout
    rows: np.ndarray
    values: np.ndarray
    start: float

    def continued_by(self, other: "Segment") -> bool:
        """Return True if `other`, from another file, continues this segment without a gap in time and position."""
        mine, others, count = self.layout, other.layout, 1 + len(self.layout.joints)
        if mine.file == others.file or (mine.columns, mine.mapping) != (others.columns, others.mapping):
            return False
        if mine.mapping.sample_rate or len(self.values) < 2:
            return False
        steps = np.diff(self.values[:, :count], axis=0)
        step = other.values[0, :count] - self.values[-1, :count]
        step[0] += other.start - self.start
        largest = np.array([np.median(steps[:, 0]), *np.abs(steps[:, 1:]).max(axis=0)])
        return bool(min(step[0], *steps[:, 0]) > 0 and (np.abs(step) <= TUNING.gap * largest).all())


class LogSegments:
    """Collector of the segments of recordings, which keeps only every k-th segment if a limit of memory requires it.

    Segments are numbered in the order of the files. The attribute `every` is k: it is 1 at first, and is doubled
    whenever the kept segments would need more than `kept_bytes` bytes. The kept segments are evenly spread over all
    files. Without a limit, each recording is one segment. The attribute `rows` is the number of rows of all added
    tables.
    """

    def __init__(self, kept_bytes: float = inf) -> None:
        self.every = 1
        self.rows = 0
        self._kept_bytes = kept_bytes
        self._segments: list[Segment] = []
        self._bytes = self._recordings = self._count = 0

    def add(self, layout: Layout, table: pa.Table) -> None:
        """Convert the recordings of a table to segments in SI units, and add the segments that are kept.

        Raises LogError if the table has no rows, or if a kept row contains values that are not numbers.
        """
        if not table.num_rows:
            raise LogError("no rows", file=layout.file, expected="at least one window of samples")
        (first, start), pieces = clock_start(table, layout), []
        for name, rows in _recordings(layout, table):
            count = 1 if self._kept_bytes == inf else -(-len(rows) // TUNING.segment_samples)
            pieces += [(self._recordings, name, piece) for piece in np.array_split(rows, count)]
            self._recordings += 1
        pieces = self._selected(pieces, 8 * len(layout.columns))
        # A table that is kept completely is converted in one call. This is faster than one call per recording, and an
        # error can state the number of faulty rows in the whole table.
        data = values_in_si(table, layout, first, range(table.num_rows)) if self.every == 1 else None
        for recording, name, rows in pieces:
            values = values_in_si(_rows_of(table, rows), layout, first, rows) if data is None else data[rows]
            self._segments.append(Segment(recording, name, layout, rows, values, start))
            self._bytes += values.nbytes
        self.rows += table.num_rows

    def trajectories(self) -> Iterator[Trajectory | LogError]:
        """Yield the trajectory of each recording, or a LogError if its times are wrong.

        Files that continue each other are one recording. The collector is empty afterwards.
        """
        recordings = [list(group) for _, group in groupby(self._segments, key=lambda x: x.recording)]
        self._segments = []
        recordings = _joined_files(recordings)[::-1]
        # Segments are removed from the collector before they are joined to a recording, so that there is no second copy
        # of all rows.
        while recordings:
            group = recordings.pop()
            first = group[0]
            values = np.concatenate([x.values for x in group]) if len(group) > 1 else first.values
            rows = np.concatenate([x.rows for x in group])
            try:
                yield make_trajectory(values, rows, first.layout, first.name)
            except LogError as error:
                yield error

    def _selected(self, pieces: list[Piece], row_bytes: int) -> list[Piece]:
        """Return the segments to keep of `pieces`, the segments of a table.

        One of `every` segments is kept. If the kept segments of all tables would exceed `kept_bytes`, `every` is
        doubled, and every second segment of the earlier tables is removed. row_bytes: memory of one row [B].
        """
        while True:
            selected = pieces[-self._count % self.every :: self.every]
            size = self._bytes + row_bytes * sum(len(rows) for _, _, rows in selected)
            if size <= self._kept_bytes or len(self._segments) + len(selected) <= 1:
                self._count += len(pieces)
                return selected
            # Every second collected segment is removed, so that the remaining segments are evenly spread.
            self.every *= 2
            self._segments = self._segments[::2]
            self._bytes = sum(x.values.nbytes for x in self._segments)


def _joined_files(recordings: list[list[Segment]]) -> list[list[Segment]]:
    """Return the segments of each recording, in the given order; files that continue each other are one recording."""
    joined: list[list[Segment]] = []
    for group in sorted(recordings, key=lambda x: x[0].start + x[0].values[0, 0]):
        if not joined or not joined[-1][-1].continued_by(group[0]):
            joined.append([])
        first = joined[-1][0] if joined[-1] else group[0]
        for segment in group:
            segment.values[:, 0] += segment.start - first.start
            joined[-1].append(segment._replace(start=first.start))
    for group in joined:
        layout, last = group[0].layout, group[-1].layout.file
        if last != layout.file:
            remark = f"the files up to {last.name} continue it by time and position, and were joined"
            group[0] = group[0]._replace(layout=replace(layout, remarks=(*layout.remarks, remark)))
    return sorted(joined, key=lambda x: x[0].recording)


def _rows_of(table: pa.Table, rows: np.ndarray) -> pa.Table:
    """Return a table of the rows with the indices `rows` (T,) of a table; consecutive rows are not copied."""
    first, count = int(rows[0]), len(rows)
    return table.slice(first, count) if int(rows[-1]) - first + 1 == count else table.take(rows)


def _recordings(layout: Layout, table: pa.Table) -> list[tuple[str, np.ndarray]]:
    """Return (name, row numbers (T,)) for each recording in a table, in the order of their first rows."""
    if layout.labels is None:
        return [(layout.recording or layout.file.stem, np.arange(table.num_rows))]
    # Names of recordings (labels) are encoded as numbers, so that each text is stored once: a small compressed file may
    # repeat a label of a megabyte in a million rows.
    labels = table[layout.labels].dictionary_encode("encode").combine_chunks()
    numbers = labels.indices.to_numpy()
    # Rows of a table are sorted by the name of their recording once, which avoids a search of all rows for each
    # recording.
    rows = np.argsort(numbers, kind="stable")
    ends = np.cumsum(np.bincount(numbers))
    return list(zip(map(str, labels.dictionary.to_pylist()), np.split(rows, ends[:-1]), strict=True))
