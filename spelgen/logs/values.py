"""Turn columns as they were logged into numbers in SI units and the URDF's senses, or name the row that is none."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute

from spelgen.errors import LogError
from spelgen.logs.tables import Layout, list_element
from spelgen.settings.log_mapping import TIMES
from spelgen.settings.tuning.logs import LogTuning

TUNING = LogTuning()


def values_in_si(
    table: pa.Table | pa.RecordBatch, layout: Layout, file: Path, start: int, row: int = 0
) -> np.ndarray:
    """Return the columns of a layout (T, C) in SI units, times from `start` on. row: of the table in its file.

    Raises LogError naming row and column where a value is no number, or none that an arm can have.
    """
    logged = [times_from(table, layout, file, start, row)]
    logged += [floats(column(table, name), name, file, row) for name in layout.columns[1:]]
    factors, offsets = layout.units
    # what overflows is told below, with its row
    with np.errstate(over="ignore", invalid="ignore"):
        data: np.ndarray = np.stack(logged, axis=1) * factors + offsets
    _require_possible(data, layout.columns, file, row)
    return data


def _require_possible(data: np.ndarray, columns: Sequence[str], file: Path, first: int) -> None:
    """Raise LogError where data (T, C) in SI units, from row `first` of the file on, is no number or far too large."""
    bad = ~np.isfinite(data)
    largest = np.array([TUNING.latest] + [TUNING.largest_value] * (len(columns) - 1))
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
        file=file, line=line_of(file, row + first), element=f"row {row + first + 1}, column {columns[column]}",
        expected=expected, do=do,
    )  # fmt: skip


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


def column(table: pa.Table | pa.RecordBatch, name: str) -> pa.ChunkedArray | pa.Array:
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


def floats(values: pa.ChunkedArray | pa.Array, column: str, file: Path, row: int) -> np.ndarray:
    """Return a column as float64 (T,)."""
    try:
        floats: np.ndarray = values.cast(pa.float64()).to_numpy(zero_copy_only=False)
        return floats
    except (pa.ArrowException, ValueError) as error:
        # Arrow does not say which row
        if pa.types.is_string(values.type):
            for index, text in enumerate(values.to_pylist()):
                if text and not is_number(text):
                    raise LogError(
                        repr(text[:60]), file=file, line=line_of(file, row + index),
                        element=f"row {row + index + 1}, column {column}", expected="a number",
                    ) from error  # fmt: skip
        got = f"values of type {values.type}"
        raise LogError(got, file=file, element=f"column {column}", expected="numbers") from error


def is_number(text: str) -> bool:
    """Whether a text is a number, as Python writes it."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def line_of(file: Path, row: int) -> int | None:
    """Return the line of a 0-based data row, where the format has lines (a CSV's first is its header)."""
    return int(row) + 2 if file.suffix == ".csv" else None
