"""Columns as they were logged -> numbers in SI units and the URDF's senses, or the row that is none."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute

from spelgen.errors import LogError
from spelgen.logs.tables import Layout, element, wanted_quantities
from spelgen.logs.trajectory import LARGEST, Trajectory, gap_ends
from spelgen.settings.log_mapping import TIMES

EXACT = 2**53  # whole numbers up to here are exact as floating-point numbers
CLOCKS: tuple[tuple[Callable[[pa.DataType], bool], pa.DataType], ...] = (
    (pa.types.is_duration, pa.duration("ns")),
    (pa.types.is_time, pa.time64("ns")),
    (pa.types.is_temporal, pa.timestamp("ns")),
)


def clock_start(times: pa.ChunkedArray | pa.Array) -> int:
    """From where times count: the first one of a clock too wide for floating-point numbers, else 0."""
    first = _nanoseconds(times[:1])
    first = times[:1] if first is None else first
    start = first[0].as_py() if pa.types.is_integer(first.type) else None
    return start if start and (abs(start) > EXACT or first.type != times.type) else 0


def values_in_si(
    table: pa.Table | pa.RecordBatch, layout: Layout, file: Path, start: int, row: int = 0
) -> np.ndarray:
    """The columns of a layout (T, C) in SI units, times from `start` on. row: of the table in its file.

    Raises LogError naming row and column where a value is no number, or none that an arm can have.
    """
    logged = [_times(table, layout, file, start, row)]
    logged += [_numbers(_column(table, name), name, file, row) for name in layout.columns[1:]]
    factors, offsets = layout.units
    with np.errstate(over="ignore", invalid="ignore"):
        data = np.stack(logged, axis=1) * factors + offsets
    _require_possible(data, layout.columns, file, row)
    return data


def column_values(table: pa.Table, name: str, file: Path) -> np.ndarray:
    """A column (T,) as it was logged. Raises LogError where a value is no number."""
    return _numbers(_column(table, name), name, file, 0)


def made_trajectory(data: np.ndarray, layout: Layout, **about: Any) -> Trajectory:
    """A trajectory of these rows (T, C) in SI units, velocities differentiated where there are none."""
    quantities = wanted_quantities(layout.mapping)
    t, found = data[:, 0], dict(zip(quantities, np.split(data[:, 1:], len(quantities), axis=1), strict=True))
    qd = found["qd"] if "qd" in found else _differentiated(t, found["q"])
    tau = earlier(t, found["tau"], layout.mapping.torque_delay) if "tau" in found else np.zeros((len(t), 0))
    return Trajectory(
        t, found["q"], qd, tau, u=found.get("u"),
        declares_units=layout.declares_units, **about,
    )  # fmt: skip


def _differentiated(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Central differences (T, n) within each gap-free piece; 0 for a sample alone, of which no window is cut."""
    qd = np.zeros_like(q)
    for start, stop in pairwise(gap_ends(t)):
        if stop - start > 1:
            qd[start:stop] = np.gradient(q[start:stop], t[start:stop], axis=0)
    return qd


def earlier(t: np.ndarray, values: np.ndarray, delay: float) -> np.ndarray:
    """What is logged so much later [s], (T, n), held at the ends of each gap-free piece."""
    if not delay:
        return values
    moved = values.copy()
    for start, stop in pairwise(gap_ends(t)):
        piece = slice(start, stop)
        for column, logged in zip(moved.T, values.T, strict=True):
            column[piece] = np.interp(t[piece] + delay, t[piece], logged[piece])
    return moved


def _times(table: pa.Table | pa.RecordBatch, layout: Layout, file: Path, start: int, row: int) -> np.ndarray:
    """The times (T,) in the layout's unit, from `start` on."""
    name = layout.columns[0]
    times = _column(table, name)
    nanoseconds = _nanoseconds(times)
    if nanoseconds is not None and not nanoseconds.null_count:
        return (nanoseconds.to_numpy() - start) * 1e-9 / TIMES[layout.mapping.units.t]
    if start and nanoseconds is None and not times.null_count:
        return (times.to_numpy() - start).astype(float)
    return _numbers(times, name, file, row)


def _nanoseconds(times: pa.ChunkedArray | pa.Array) -> pa.ChunkedArray | pa.Array | None:
    """What a clock with a type of its own says [ns]; None of plain numbers."""
    wide = next((wide for has, wide in CLOCKS if has(times.type)), None)
    return None if wide is None else times.cast(wide).cast(pa.int64())


def _column(table: pa.Table | pa.RecordBatch, name: str) -> pa.ChunkedArray | pa.Array:
    """A column, or what `position[2]` names: the place of each of its lists, written as text maybe."""
    found = element(name, table.schema.names)
    if found is None:
        return table.column(name)
    lists, place = table.column(found[0]), found[1]
    text = not pa.types.is_nested(lists.type)
    if text:
        bare = pa.compute.replace_substring_regex(lists.cast(pa.string()), r"^.*[\[(]\s*|\s*[\])].*$", "")
        lists = pa.compute.split_pattern_regex(bare, r"[,;\s]+")
    long = pa.compute.greater(pa.compute.list_value_length(lists), place)
    elements = pa.compute.list_element(pa.compute.if_else(long, lists, pa.scalar(None, lists.type)), place)
    return pa.compute.replace_substring_regex(elements, "^$", "nan") if text else elements


def _numbers(values: pa.ChunkedArray | pa.Array, column: str, file: Path, row: int) -> np.ndarray:
    """A column as float64 (T,)."""
    try:
        return values.cast(pa.float64()).to_numpy(zero_copy_only=False)
    except (pa.ArrowException, ValueError) as error:
        bad = _first_bad(values.to_pylist()) if pa.types.is_string(values.type) else None
        if bad is None:
            raise LogError(
                f"values of type {values.type}", file=file, element=f"column {column}", expected="numbers"
            ) from error
        raise LogError(
            repr(bad[1][:60]), file=file, line=_line(file, row + bad[0]),
            element=f"row {row + bad[0] + 1}, column {column}", expected="a number",
        ) from error  # fmt: skip


def _first_bad(texts: Sequence[str | None]) -> tuple[int, str] | None:
    for row, text in enumerate(texts):
        try:
            float(text or "nan")
        except ValueError:
            return row, str(text)
    return None


def _require_possible(data: np.ndarray, columns: Sequence[str], file: Path, first: int) -> None:
    """Raise LogError where data (T, C) in SI units, from row `first` of the file on, is no number or far too large."""
    bad = ~np.isfinite(data)
    bad[:, 1:] |= ~(np.abs(data[:, 1:]) < LARGEST)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        value, count = data[row, column], int(bad.any(axis=1).sum())
        got, expected, do = "no finite number", "a number", "remove those rows; a gap in t is understood"
        if np.isfinite(value):
            got, expected, do = (
                f"{value:.3g} in SI units",
                f"a number below {LARGEST:g}",
                "check units and gains",
            )
        raise LogError(
            f"{got} ({count} of {len(data)} rows have such a {'value' if np.isfinite(value) else 'gap'}, "
            "this is the first)",
            file=file, line=_line(file, row + first), element=f"row {row + first + 1}, column {columns[column]}",
            expected=expected, do=do,
        )  # fmt: skip


def require_increasing_times(t: np.ndarray, rows: np.ndarray, file: Path, column: str) -> None:
    """Raise LogError unless times (T,), of these rows of the file, increase."""
    back = np.flatnonzero(np.diff(t) <= 0)
    if back.size:
        k = int(back[0])
        raise LogError(
            f"t = {t[k + 1]:g} s after {t[k]:g} s ({back.size} such steps, this is the first)",
            file=file, line=_line(file, rows[k + 1]), element=f"row {rows[k + 1] + 1}, column {column}",
            expected="increasing times",
            do="sort the rows, drop repeats, or split recordings by a column 'trajectory'",
        )  # fmt: skip


def _line(file: Path, row: int) -> int | None:
    """The line of a 0-based data row, where the format has lines (a CSV's first is its header)."""
    return int(row) + 2 if file.suffix == ".csv" else None
