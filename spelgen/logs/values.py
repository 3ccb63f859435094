"""Turn columns as they were logged into numbers in SI units and the URDF's senses, or name the row that is none."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute

from spelgen.errors import LogError
from spelgen.logs.tables import Layout, list_element, wanted_quantities
from spelgen.logs.trajectory import LATEST, SHORTEST, Trajectory, gap_ends
from spelgen.settings.log_mapping import TIMES
from spelgen.settings.tuning.logs import LogTuning

TUNING = LogTuning()
LONGEST = 1e8  # in whatever unit of time: no recording begins so late on a clock of its own


def clock_start(times: pa.ChunkedArray | pa.Array) -> int:
    """Return from where times count: the first one of a clock that shows the date, else 0."""
    first = times[:1]
    try:
        nanoseconds = _nanoseconds(first)
    except pa.ArrowInvalid:
        return 0  # told of by `_times`, which knows the file
    if nanoseconds is not None:
        return nanoseconds[0].as_py() or 0
    if not (pa.types.is_integer(first.type) or pa.types.is_floating(first.type)):
        return 0
    start = first[0].as_py()
    # seconds since 1970 leave floating-point numbers no digits for what follows
    return int(start) if start is not None and LONGEST < abs(start) < np.inf else 0


def values_in_si(
    table: pa.Table | pa.RecordBatch, layout: Layout, file: Path, start: int, row: int = 0
) -> np.ndarray:
    """Return the columns of a layout (T, C) in SI units, times from `start` on. row: of the table in its file.

    Raises LogError naming row and column where a value is no number, or none that an arm can have.
    """
    logged = [_times(table, layout, file, start, row)]
    logged += [_floats(_column(table, name), name, file, row) for name in layout.columns[1:]]
    factors, offsets = layout.units
    # what overflows is told below, with its row
    with np.errstate(over="ignore", invalid="ignore"):
        data: np.ndarray = np.stack(logged, axis=1) * factors + offsets
    _require_possible(data, layout.columns, file, row)
    return data


def column_values(table: pa.Table, name: str, file: Path) -> np.ndarray:
    """Return a column (T,) as it was logged. Raises LogError where a value is no number."""
    return _floats(_column(table, name), name, file, 0)


def make_trajectory(
    data: np.ndarray, layout: Layout, name: str, file: Path, repairs: tuple[str, ...] = ()
) -> Trajectory:
    """Return a trajectory of these rows (T, C) in SI units, velocities differentiated where there are none."""
    quantities = wanted_quantities(layout.mapping)
    if layout.mapping.dropouts == "dropped":
        holes = np.any([is_dropout(column) for column in data[:, 1:].T], axis=0)
        if holes.any():
            data = data[~holes]
            repairs += (f"{holes.sum()} rows in which a signal fell to 0 were left out",)
    t = data[:, 0]
    signals = dict(zip(quantities, np.split(data[:, 1:], len(quantities), axis=1), strict=True))
    q = signals["q"]
    qd = signals["qd"] if "qd" in signals else _differentiated(t, q)
    tau = np.zeros((len(t), 0))
    if "tau" in signals:
        tau = earlier(t, signals["tau"], layout.mapping.torque_delay)
    return Trajectory(t, q, qd, tau, name, file, layout.accepted, signals.get("u"), repairs)


def is_dropout(values: np.ndarray) -> np.ndarray:
    """Whether each sample (T,) is exactly 0 between samples that are far from 0: what loggers write for no value."""
    dropout = np.zeros(len(values), bool)
    edges = np.diff((values == 0).astype(int))
    starts, stops = np.flatnonzero(edges > 0) + 1, np.flatnonzero(edges < 0) + 1
    if not starts.size:
        return dropout
    steps = np.abs(np.diff(values[values != 0]))
    usual = np.median(steps[steps > 0]) if steps.any() else np.inf
    stops = stops[stops > starts[0]]
    starts = starts[: len(stops)]  # zeros at the end have nothing behind them
    # a signal that passes through 0 comes near it first
    nearest = np.minimum(np.abs(values[starts - 1]), np.abs(values[stops]))
    far = nearest > TUNING.dropout * usual
    for start, stop in zip(starts[far].tolist(), stops[far].tolist(), strict=True):
        dropout[start:stop] = True
    return dropout


def _differentiated(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return central differences (T, n) within each gap-free piece; 0 for a lone sample, of which no window is cut."""
    qd = np.zeros_like(q)
    for start, stop in pairwise(gap_ends(t)):
        if stop - start > 1:
            qd[start:stop] = np.gradient(q[start:stop], t[start:stop], axis=0)
    return qd


def earlier(t: np.ndarray, values: np.ndarray, delay: float) -> np.ndarray:
    """Return what is logged so much later [s], (T, n), held at the ends of each gap-free piece."""
    if not delay:
        return values
    moved = values.copy()
    for start, stop in pairwise(gap_ends(t)):
        piece = slice(start, stop)
        for joint in range(values.shape[1]):
            moved[piece, joint] = np.interp(t[piece] + delay, t[piece], values[piece, joint])
    return moved


def _times(table: pa.Table | pa.RecordBatch, layout: Layout, file: Path, start: int, row: int) -> np.ndarray:
    """Return the times (T,) in the layout's unit, from `start` on."""
    name = layout.columns[0]
    times = _column(table, name)
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
        return np.asarray(times.to_numpy() - start, dtype=float)
    return _floats(times, name, file, row)


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


def _column(table: pa.Table | pa.RecordBatch, name: str) -> pa.ChunkedArray | pa.Array:
    """Return a column, or of a name like `position[2]` that element of each of its lists, written as text maybe."""
    element = list_element(name, table.schema.names)
    if element is None:
        return table.column(name)
    lists, index = table.column(element[0]), element[1]
    is_text = not pa.types.is_nested(lists.type)
    if is_text:
        bare = pa.compute.replace_substring_regex(lists.cast(pa.string()), r"^.*[\[(]\s*|\s*[\])].*$", "")
        lists = pa.compute.split_pattern_regex(bare, r"[,;\s]+")
    # Arrow raises for an index beyond a list, where a missing number is what it means
    long_enough = pa.compute.greater(pa.compute.list_value_length(lists), index)
    lists = pa.compute.if_else(long_enough, lists, pa.scalar(None, lists.type))
    elements = pa.compute.list_element(lists, index)
    return pa.compute.replace_substring_regex(elements, "^$", "nan") if is_text else elements


def _floats(values: pa.ChunkedArray | pa.Array, column: str, file: Path, row: int) -> np.ndarray:
    """Return a column as float64 (T,)."""
    try:
        floats: np.ndarray = values.cast(pa.float64()).to_numpy(zero_copy_only=False)
        return floats
    except (pa.ArrowException, ValueError) as error:
        # Arrow does not say which row
        if pa.types.is_string(values.type):
            for index, text in enumerate(values.to_pylist()):
                if not _is_number(text):
                    raise LogError(
                        repr(text[:60]), file=file, line=_line(file, row + index),
                        element=f"row {row + index + 1}, column {column}", expected="a number",
                    ) from error  # fmt: skip
        got = f"values of type {values.type}"
        raise LogError(got, file=file, element=f"column {column}", expected="numbers") from error


def _is_number(text: str | None) -> bool:
    try:
        float(text or "nan")
    except ValueError:
        return False
    return True


def _require_possible(data: np.ndarray, columns: Sequence[str], file: Path, first: int) -> None:
    """Raise LogError where data (T, C) in SI units, from row `first` of the file on, is no number or far too large."""
    bad = ~np.isfinite(data)
    largest = np.array([LATEST] + [TUNING.largest_value] * (len(columns) - 1))
    bad |= ~(np.abs(data) < largest)
    if not bad.any():
        return
    row, column = np.argwhere(bad)[0]
    value, count = data[row, column], int(bad.any(axis=1).sum())
    got, kind, expected = "no finite number", "gap", "a number"
    do = "remove those rows; a gap in t is understood"
    if np.isfinite(value):
        got, kind = f"{value:.3g} in SI units", "value"
        expected, do = f"a number below {largest[column]:g}", "check units and gains"
    raise LogError(
        f"{got} ({count} of {len(data)} rows have such a {kind}, this is the first)",
        file=file, line=_line(file, row + first), element=f"row {row + first + 1}, column {columns[column]}",
        expected=expected, do=do,
    )  # fmt: skip


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
    backward = np.flatnonzero(np.diff(t) < SHORTEST)
    if backward.size:
        k = int(backward[0])
        raise LogError(
            f"t = {t[k + 1]:g} s after {t[k]:g} s ({backward.size} such steps, this is the first)",
            file=file, line=_line(file, rows[k + 1]), element=f"row {rows[k + 1] + 1}, column {column}",
            expected="increasing times",
            do="sort the rows, drop repeats, or split recordings by a column 'trajectory'",
        )  # fmt: skip


def _line(file: Path, row: int) -> int | None:
    """Return the line of a 0-based data row, where the format has lines (a CSV's first is its header)."""
    return int(row) + 2 if file.suffix == ".csv" else None
