"""Put the rows of logs in the order of their times."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from spelgen.errors import LogError
from spelgen.logs.tables import Layout
from spelgen.logs.values import line_of
from spelgen.settings.tuning.logs import LogTuning

TUNING = LogTuning()


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
