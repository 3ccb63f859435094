"""Turn columns as they were logged into numbers in SI units and the URDF's senses, or name the row that is none."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

from spelgen.errors import LogError
from spelgen.logs.clock import times_from
from spelgen.logs.columns import column, floats, line_of
from spelgen.logs.tables import Layout
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
