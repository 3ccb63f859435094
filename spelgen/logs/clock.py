"""Read the times of logs, and put rows in their order."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa

from spelgen.errors import LogError
from spelgen.logs.columns import column, floats, line_of
from spelgen.logs.tables import Layout
from spelgen.settings.log_mapping import TIMES
from spelgen.settings.tuning.logs import LogTuning

TUNING = LogTuning()


def clock_start(times: pa.ChunkedArray | pa.Array) -> int:
    """Return from where times count: the first one of a clock that shows the date, else 0."""
    first = times[:1]
    try:
        nanoseconds = _nanoseconds(first)
    except pa.ArrowInvalid:
        return 0  # told of by `times_from`, which knows the file
    if nanoseconds is not None:
        return nanoseconds[0].as_py() or 0
    if not (pa.types.is_integer(first.type) or pa.types.is_floating(first.type)):
        return 0
    start = first[0].as_py()
    # seconds since 1970 leave floating-point numbers no digits for what follows
    return int(start) if start is not None and TUNING.longest_clock < abs(start) < np.inf else 0


def times_from(
    table: pa.Table | pa.RecordBatch, layout: Layout, file: Path, start: int, row: int
) -> np.ndarray:
    """Return the times (T,) in the layout's unit, from `start` on."""
    name = layout.columns[0]
    times = column(table, name)
    try:
        nanoseconds = _nanoseconds(times)
    except pa.ArrowInvalid as error:
        raise LogError(
            f"dates beyond what nanoseconds count ({times.type})", file=file, element=f"column {name}",
            expected="years from 1678 to 2262", do="check the unit of the stamps",
        ) from error  # fmt: skip
    # integers are subtracted before they become floats: 1.7e18 ns keeps no microseconds as a double
    if nanoseconds is not None and not nanoseconds.null_count:
        counts: np.ndarray = nanoseconds.to_numpy()
        return np.asarray((counts - start) * 1e-9 / TIMES[layout.mapping.units.t])
    if start and nanoseconds is None and not times.null_count:
        with np.errstate(over="ignore"):  # infinite times are refused below
            return np.asarray(times.to_numpy() - start, dtype=float)
    return floats(times, name, file, row)


def _nanoseconds(times: pa.ChunkedArray | pa.Array) -> pa.ChunkedArray | pa.Array | None:
    """Return what a clock with a type of its own says [ns]; None of plain numbers."""
    if pa.types.is_duration(times.type):
        wide = pa.duration("ns")
    elif pa.types.is_time(times.type):
        wide = pa.time64("ns")
    elif pa.types.is_temporal(times.type):
        wide = pa.timestamp("ns")
    else:
        return None
    return times.cast(wide).cast(pa.int64())


def in_time_order(
    data: np.ndarray, rows: np.ndarray, layout: Layout, file: Path
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return values (T, C) of these rows of a file with increasing times, and what was mended for that.

    Rows are sorted where positions become smoother by it, and of rows of one time the first is taken. Raises LogError
    for a clock that begins anew, or that is too coarse.
    """
    t = data[:, 0]
    repairs: tuple[str, ...] = ()
    late = np.flatnonzero(np.diff(t) < 0)
    if late.size:
        ordered = data[np.argsort(t, kind="stable")]
        positions = slice(1, 1 + len(layout.joints))
        # two recordings in one file would be interleaved by sorting
        if _roughness(ordered[:, positions]) > _roughness(data[:, positions]):
            require_increasing_times(t, rows, file, layout.columns[0])
        data = ordered
        repairs += (f"{late.size} times before that of the row above: the rows were sorted",)
    is_repeat = np.diff(data[:, 0], prepend=-np.inf) == 0
    repeats = int(is_repeat.sum())
    if 2 * repeats > len(data):
        raise LogError(
            f"{repeats} of {len(data)} rows with the time of another row", file=file,
            element=f"column {layout.columns[0]}", expected="a time for each row",
            do="log times with more digits, or split recordings by a column 'trajectory'",
        )  # fmt: skip
    if repeats:
        data = data[~is_repeat]
        repairs += (f"{repeats} rows with the time of the row before were left out",)
    return data, repairs


def _roughness(positions: np.ndarray) -> float:
    """Return the way that joints go from row to row, each relative to its range."""
    ranges = np.ptp(positions, axis=0)
    way = np.abs(np.diff(positions, axis=0)).sum(axis=0)
    return float((way / np.where(ranges > 0, ranges, 1.0)).sum())


def require_increasing_times(t: np.ndarray, rows: np.ndarray, file: Path, column: str) -> None:
    """Raise LogError unless times (T,), of these rows of the file, increase."""
    backward = np.flatnonzero(np.diff(t) < TUNING.shortest_step)
    if backward.size:
        k = int(backward[0])
        raise LogError(
            f"t = {t[k + 1]:g} s after {t[k]:g} s ({backward.size} such steps, this is the first)",
            file=file, line=line_of(file, rows[k + 1]), element=f"row {rows[k + 1] + 1}, column {column}",
            expected="increasing times",
            do="sort the rows, drop repeats, or split recordings by a column 'trajectory'",
        )  # fmt: skip
