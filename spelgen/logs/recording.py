"""Make trajectories of rows in SI units: put in order, holes left out, velocities differentiated, torques moved."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from spelgen.errors import LogError
from spelgen.logs.tables import Layout
from spelgen.logs.trajectory import Trajectory, gap_ends
from spelgen.logs.tuning import TUNING


def make_trajectory(data: np.ndarray, layout: Layout, name: str, repairs: tuple[str, ...] = ()) -> Trajectory:
    """Return a trajectory of these rows (T, C) in SI units, velocities differentiated where there are none."""
    mapping = layout.mapping
    if mapping.dropouts == "dropped":
        holes = np.any([is_dropout(column) for column in data[:, 1:].T], axis=0)
        if holes.any():
            data = data[~holes]
            repairs += (f"{holes.sum()} rows in which a signal fell to 0 were left out",)
    t, columns = data[:, 0], np.split(data[:, 1:], len(mapping.quantities), axis=1)
    signals = dict(zip(mapping.quantities, columns, strict=True))
    q, tau = signals["q"], signals.get("tau", np.zeros((len(t), 0)))
    qd = signals.get("qd", np.zeros_like(q))
    if "qd" not in signals:
        for rows in _pieces(t):
            qd[rows] = np.gradient(q[rows], t[rows], axis=0)  # central differences
    tau = earlier(t, tau, mapping.torque_delay)
    return Trajectory(t, q, qd, tau, name, layout.file, layout.accepted, signals.get("u"), repairs)


def in_time_order(data: np.ndarray, rows: np.ndarray, layout: Layout) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return values (T, C) of these rows of a file with increasing times, and what was mended for that.

    Rows are sorted where positions become smoother by it, and of rows of one time the first is taken. Raises LogError
    for a clock that begins anew, or that is too coarse.
    """
    t = data[:, 0]
    repairs: tuple[str, ...] = ()
    late = np.count_nonzero(np.diff(t) < 0)
    if late:
        ordered = data[np.argsort(t, kind="stable")]
        positions = slice(1, 1 + len(layout.joints))
        # two recordings in one file would be interleaved by sorting
        if _roughness(ordered[:, positions]) > _roughness(data[:, positions]):
            require_increasing_times(t, rows, layout)
        data = ordered
        repairs += (f"{late} times before that of the row above: the rows were sorted",)
    is_repeat = np.diff(data[:, 0], prepend=-np.inf) == 0
    repeats = np.count_nonzero(is_repeat)
    if 2 * repeats > len(data):
        raise LogError(
            f"{repeats} of {len(data)} rows with the time of another row", file=layout.file,
            element=f"column {layout.columns[0]}",
            expected="a time for each row",
            do="log times with more digits, or split recordings by a column 'trajectory'",
        )  # fmt: skip
    if repeats:
        data = data[~is_repeat]
        repairs += (f"{repeats} rows with the time of the row before were left out",)
    return data, repairs


def _roughness(positions: np.ndarray) -> float:
    """Return the way that joints go from row to row, each relative to its range."""
    ranges = np.ptp(positions, axis=0)
    length = np.abs(np.diff(positions, axis=0)).sum(axis=0)
    return float((length / np.where(ranges > 0, ranges, 1.0)).sum())


def require_increasing_times(t: np.ndarray, rows: Sequence[int] | np.ndarray, layout: Layout) -> None:
    """Raise LogError unless times (T,), of these rows of the file, increase."""
    backward = np.flatnonzero(np.diff(t) < TUNING.shortest_step)
    if backward.size:
        k = backward[0]
        got = f"t = {t[k + 1]:g} s after {t[k]:g} s ({backward.size} such steps, this is the first)"
        do = "sort the rows, drop repeats, or split recordings by a column 'trajectory'"
        raise layout.row_error(got, rows[k + 1], layout.columns[0], "increasing times", do)


def is_dropout(values: np.ndarray) -> np.ndarray:
    """Whether each sample (T,) is exactly 0 between samples that are far from 0: what loggers write for no value."""
    is_lost = np.zeros(len(values), bool)
    logged = np.flatnonzero(values)
    if not logged.size or logged[-1] - logged[0] == len(logged) - 1:
        return is_lost  # zeros at either end have nothing beside them
    steps = np.abs(np.diff(values[logged]))
    usual = np.median(steps[steps > 0]) if steps.any() else np.inf
    # a signal that passes through 0 comes near it first
    nearest = np.minimum(np.abs(values[logged[:-1]]), np.abs(values[logged[1:]]))
    is_lost[logged[0] : logged[-1]] = np.repeat(nearest > TUNING.dropout * usual, np.diff(logged))
    return np.asarray(is_lost & (values == 0))


def _pieces(t: np.ndarray) -> Iterator[slice]:
    """Yield the gap-free pieces of two samples or more; of a lone sample no window is cut."""
    for start, stop in pairwise(gap_ends(t)):
        if stop - start > 1:
            yield slice(start, stop)


def earlier(t: np.ndarray, values: np.ndarray, delay: float) -> np.ndarray:
    """Return what is logged so much later [s], (T, n), held at the ends of each gap-free piece."""
    if not delay:
        return values
    from scipy.interpolate import CubicSpline  # takes long to import, as in `low_pass`

    moved = values.copy()
    for rows in _pieces(t):
        # a line from sample to sample would damp torques at times between samples, and noise with them
        spline = CubicSpline(t[rows], values[rows])
        moved[rows] = spline(np.clip(t[rows] + delay, t[rows][0], t[rows][-1]))
    return moved
