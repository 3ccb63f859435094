"""Conversion of rows in SI units to trajectories: order, wraps, repeats, outliers, velocities, delay of torques."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from math import pi

import numpy as np

from spelgen.errors import LogError
from spelgen.labels import counted
from spelgen.logs.jumps import centred, is_outlier, is_stale, jump_count, repeated_rows, unwrapped
from spelgen.logs.tables import Layout
from spelgen.logs.trajectory import Trajectory, gap_ends
from spelgen.logs.tuning import TUNING
from spelgen.logs.values import foreign_rows
from spelgen.settings.log_mapping import LogMapping

Repaired = tuple[np.ndarray, tuple[str, ...]]
"""Rows of a log (T, C), and messages on their changes."""


def make_trajectory(data: np.ndarray, layout: Layout, name: str, repairs: tuple[str, ...] = ()) -> Trajectory:
    """Return a trajectory of these rows (T, C) in SI units, velocities differentiated if none were logged.

    Before the differentiation, wrapped angles and overflowed registers are unwrapped, and repeated rows are removed;
    with 'dropouts: dropped' lost rows and outliers are removed, too.
    """
    mapping = layout.mapping
    signals = mapping.signals(layout.joints)
    data, wraps = _without_wraps(data, signals, mapping)
    data, dropped = _without_repeats(data, len(layout.joints), mapping)
    repairs += dropped
    if mapping.dropouts == "dropped":
        data, dropped = _without_outliers(data, signals)
        repairs += dropped
    t, *columns = np.split(data, [1 + len(layout.joints) * k for k in range(len(mapping.quantities))], axis=1)
    t, logged = t[:, 0], dict(zip(mapping.quantities, columns, strict=True))
    q = logged["q"]
    qd = logged.get("qd", np.zeros_like(q))
    if "qd" not in logged:
        for rows in _pieces(t):
            qd[rows] = np.gradient(q[rows], t[rows], axis=0)  # central differences
    tau = earlier(t, logged.get("tau", np.zeros((len(t), 0))), mapping.torque_delay)
    return Trajectory(
        t, q, qd, tau, name, layout.file, layout.accepted, logged.get("u"), repairs, layout.remarks + wraps, mapping
    )  # fmt: skip


def _without_wraps(data: np.ndarray, signals: Sequence[tuple[str, str]], mapping: LogMapping) -> Repaired:
    """Return rows (T, C) in which signals with a period are unwrapped, and remarks."""
    remarks: list[str] = []
    if not any(mapping.word("period", *signal) for signal in signals):
        return data, ()
    data = data.copy()
    values = dict(zip(signals, data[:, 1:].T, strict=True))
    for (quantity, joint), column in values.items():
        period = abs(mapping.scale(quantity, joint)) * (mapping.word("period", quantity, joint) or 0.0)
        if not period:
            continue
        count = jump_count(column, period)
        result = unwrapped(column, period)
        if quantity == "u":
            # commands are close to positions; their registers may start in different revolutions
            result = result - period * np.round(np.median(result - values["q", joint]) / period)
        # angles are centred within half a turn only if they wrap
        elif count or abs(period - 2 * pi) > 1e-6:
            offset = mapping.offset(quantity, joint)
            result = centred(result - offset, period) + offset
        if count:
            remarks.append(f"{quantity} of {joint!r} wraps at {period:.4g}: {counted(count, 'jump')} removed")
        column[:] = result
    return data, tuple(remarks)


def _without_repeats(data: np.ndarray, positions: int, mapping: LogMapping) -> Repaired:
    """Return rows (T, C), without repeats if all rows are repeated or 'dropouts: dropped' is set, and messages."""
    # too short to distinguish motion from rest; an archive may have thousands of such recordings
    if len(data) < TUNING.jump_window:
        return data, ()
    repeats, copies = repeated_rows(data[:, 1:], positions)
    count = int(np.count_nonzero(repeats))
    # so few have no effect on a fit
    if count <= 0.02 * len(data):
        return data, ()
    rate = (len(data) - 1 - count) / (data[-1, 0] - data[0, 0])
    if copies > 1:
        return data[~repeats], (
            f"every row is written {copies} times: repeats were left out, {rate:.3g} Hz remain",
        )
    message = f"{count} rows repeat the row before in motion"
    if mapping.dropouts == "kept":
        return data, (f"{message}: 'dropouts: dropped' under 'logs' removes them, {rate:.3g} Hz remain",)
    return data[~repeats], (f"{message}: repeats were left out, {rate:.3g} Hz remain",)


def _without_outliers(data: np.ndarray, signals: Sequence[tuple[str, str]]) -> Repaired:
    """Return rows (T, C) without lost samples and outliers, and messages that list them."""
    outliers = np.zeros(len(data), bool)
    dropped = []
    columns = dict(zip(signals, data[:, 1:].T, strict=True))
    for (quantity, joint), values in columns.items():
        rows = outlier_rows(quantity, values)
        if ("qd", joint) in columns:
            rows |= stale_rows(quantity, values, data[:, 0], columns["q", joint], columns["qd", joint])
        # commands may jump
        if quantity != "u" and rows.any():
            outliers |= rows
            dropped.append(f"{quantity} of {joint!r} at t = {listed_times(data[rows, 0])}")
    if not dropped:
        return data, ()
    message = f"{counted(int(outliers.sum()), 'row')} left out as dropouts: {'; '.join(dropped)}"
    return data[~outliers], (message,)


def outlier_rows(quantity: str, values: np.ndarray) -> np.ndarray:
    """Return a mask (T,) of lost samples and outliers of "q", "qd" or "tau"; zero velocities are not lost."""
    rows = is_outlier(values, smooth=quantity == "q")
    return np.asarray(rows & (values != 0)) if quantity == "qd" else rows


def stale_rows(quantity: str, values: np.ndarray, t: np.ndarray, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Return a mask (T,) of samples of "q", "qd" or "tau" of a moving joint that repeat an old value for long.

    A torque at its largest or smallest value is not stale, but clipped, and the last one may be of a motor at rest.
    """
    if quantity == "tau":
        stale = is_stale(values, qd, 0.2 * float(np.ptp(qd)))
        return np.asarray(stale & ~np.isin(values, [values.min(), values.max(), values[-1]]))
    from scipy.integrate import cumulative_trapezoid  # takes long to import

    return is_stale(values, cumulative_trapezoid(qd, t, initial=0) - q, 0.05)  # rad, m


def listed_times(t: np.ndarray) -> str:
    """Return a text with the first of the times (T,) [s] and the number of the others."""
    times = ", ".join(f"{x:.4g}" for x in t[: TUNING.listed].tolist())
    unlisted = len(t) - TUNING.listed
    return f"{times} s" + (f" and {unlisted} more" if unlisted > 0 else "")


def in_time_order(data: np.ndarray, rows: np.ndarray, layout: Layout) -> Repaired:
    """Return the values (T, C) of rows of a file with increasing times, and messages about repairs.

    Rows are sorted if this makes the positions smoother. Of several rows with one time the first is kept, or the times
    are reconstructed if the clock is coarse. Raises LogError for a clock that restarts or is too coarse.
    """
    repairs: tuple[str, ...] = ()
    foreign = foreign_rows(data, len(layout.joints))
    if foreign.any():
        data, rows = data[~foreign], np.asarray(rows)[~foreign]
        count, message = counted(int(foreign.sum()), "row"), "of another topic or publisher left out"
        repairs += (f"{count} {message}: without values, or with positions only",)
    if layout.mapping.sample_rate:
        data = np.column_stack([np.arange(len(data)) / layout.mapping.sample_rate, data[:, 1:]])
        return data, repairs
    t = data[:, 0]
    late = np.count_nonzero(np.diff(t) < 0)
    if late:
        ordered = data[np.argsort(t, kind="stable")]
        positions = slice(1, 1 + len(layout.joints))
        # sorting must not interleave two recordings in one file
        if _roughness(ordered[:, positions]) > _roughness(data[:, positions]):
            raise _backward_times(t, rows, layout)
        data = ordered
        repairs += (f"{late} times before that of the row above: the rows were sorted",)
    is_repeat = np.diff(data[:, 0], prepend=-np.inf) == 0
    differs = is_repeat & np.append(False, (np.diff(data[:, 1:], axis=0) != 0).any(axis=1))
    # many rows with equal times and different values: the clock is coarse; up to ten are accidental
    if np.count_nonzero(differs) > max(10, 0.02 * len(data)):
        t, message = _reconstructed(data[:, 0], layout)
        return np.column_stack([t, data[:, 1:]]), (*repairs, message)
    repeats = np.count_nonzero(is_repeat)
    if repeats:
        data = data[~is_repeat]
        repairs += (f"{repeats} rows with the time of the row before were left out",)
    return data, repairs


def _reconstructed(t: np.ndarray, layout: Layout) -> tuple[np.ndarray, str]:
    """Return evenly spaced times (T,) for times of a coarse clock, and a message.

    Raises LogError unless each time equals the evenly spaced one within a tick of the clock.
    """
    steps = np.diff(t)
    tick = float(steps[steps > 0].min(initial=np.inf))
    # a step longer than the rounding of the clock explains is a gap
    holes = np.flatnonzero(steps > TUNING.gap * max(tick, float(steps.mean()))) + 1
    times, rates = t.copy(), []
    for start, stop in pairwise([0, *holes.tolist(), len(t)]):
        numbers = np.arange(stop - start)
        slope, first = np.polyfit(numbers, t[start:stop], 1) if len(numbers) > 2 else (0.0, t[start])
        times[start:stop] = first + slope * numbers
        rates.append(slope)
    if np.abs(times - t).max() > tick or not min(rates) > 0:
        count = np.count_nonzero(steps == 0)
        raise LogError(
            f"{count} of {len(t)} rows with the time of another row, but another state", file=layout.file,
            element=f"column {layout.columns[0]}", expected="a time for each row",
            do="log times with more digits, split recordings by a column 'trajectory', or write "
            "'sample_rate: HZ' under 'logs' if the rows are evenly spaced",
        )  # fmt: skip
    rate = 1 / float(np.median(rates))
    message = f"the clock has ticks of {tick:.3g} s, too coarse for the rows: times were reconstructed, {rate:.4g} Hz"
    return times, message


def _roughness(positions: np.ndarray) -> float:
    """Return the path length of positions (T, n), summed over joints and relative to their ranges."""
    ranges = np.ptp(positions, axis=0)
    length = np.abs(np.diff(positions, axis=0)).sum(axis=0)
    return float((length / np.where(ranges > 0, ranges, 1.0)).sum())


def _backward_times(t: np.ndarray, rows: np.ndarray, layout: Layout) -> LogError:
    """Return the error of times (T,) that do not increase; rows: their numbers in the file."""
    backward = np.flatnonzero(np.diff(t) < TUNING.shortest_step)
    k = backward[0]
    got = f"t = {t[k + 1]:g} s after {t[k]:g} s ({backward.size} such steps, this is the first)"
    do = "sort the rows, drop repeats, or split recordings by a column 'trajectory'"
    return layout.row_error(got, rows[k + 1], layout.columns[0], "increasing times", do)


def _pieces(t: np.ndarray) -> Iterator[slice]:
    """Yield the gap-free pieces of at least two samples of times (T,)."""
    yield from (slice(start, stop) for start, stop in pairwise(gap_ends(t)) if stop - start > 1)


def earlier(t: np.ndarray, values: np.ndarray, delay: float) -> np.ndarray:
    """Return delayed values (T, n) shifted back by the delay [s], constant at the ends of each gap-free piece."""
    if not delay:
        return values
    from scipy.interpolate import CubicSpline  # takes long to import, as in `low_pass`

    moved = values.copy()
    for rows in _pieces(t):
        # cubic: linear interpolation would attenuate high frequencies of the torques
        spline = CubicSpline(t[rows], values[rows])
        moved[rows] = spline(np.clip(t[rows] + delay, t[rows][0], t[rows][-1]))
    return moved
