"""Conversion of rows in SI units to trajectories: sorting, unwrapping, removal of repeats, velocities, torque delay."""

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from math import pi

import numpy as np

from spelgen.errors import LogError
from spelgen.labels import counted
from spelgen.logs.jumps import (
    centred,
    is_outlier,
    is_stale,
    jump_count,
    read_as_words,
    repeated_rows,
    unwrapped,
)
from spelgen.logs.tables import Layout
from spelgen.logs.trajectory import Trajectory, gap_ends
from spelgen.logs.tuning import SIGNALS, TUNING
from spelgen.logs.values import foreign_rows, is_split
from spelgen.settings.log_mapping import LogMapping

Repaired = tuple[np.ndarray, tuple[str, ...]]
"""Rows of a log, (T, C) with C columns, after a repair, and messages about the changes."""


def make_trajectory(data: np.ndarray, layout: Layout, name: str, repairs: tuple[str, ...] = ()) -> Trajectory:
    """Return the trajectory of the rows `data`, (T, C) in SI units, with the C columns of the layout.

    First wrapped angles and overflowed registers are unwrapped, and repeated rows are removed; with the setting
    'dropouts: dropped' lost rows and outliers are removed, too. Then the signals are shifted by the mapping's delays,
    and velocities that were not logged are computed by differentiation. repairs: messages about changed rows.
    """
    mapping = layout.mapping
    signals = mapping.signals(layout.joints)
    data, wraps = _without_wraps(data, signals, mapping)
    data, dropped = _without_repeats(data, len(layout.joints), mapping)
    repairs += dropped
    if mapping.dropouts == "dropped":
        data, dropped = _without_outliers(data, signals)
        repairs += dropped
    data = _without_delays(data, signals, mapping)
    t, *columns = np.split(data, [1 + len(layout.joints) * k for k in range(len(mapping.quantities))], axis=1)
    t, logged = t[:, 0], dict(zip(mapping.quantities, columns, strict=True))
    q = logged["q"]
    qd = logged.get("qd", np.zeros_like(q))
    if "qd" not in logged:
        for rows in _pieces(t):
            qd[rows] = np.gradient(q[rows], t[rows], axis=0)  # central difference of q
    tau = logged.get("tau", np.zeros((len(t), 0)))
    return Trajectory(
        t, q, qd, tau, name, layout.file, layout.accepted, logged.get("u"), repairs, layout.remarks + wraps, mapping
    )  # fmt: skip


def _without_wraps(data: np.ndarray, signals: Sequence[tuple[str, str]], mapping: LogMapping) -> Repaired:
    """Return the rows `data`, (T, C) with C columns, after unwrapping of signals, and remarks about the wraps.

    Signals are unwrapped if the mapping states a period for them. signals: quantity and joint of each column after the
    times.
    """
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
        if count and quantity == "q":
            scale = mapping.scale(quantity, joint)
            word = read_as_words((column - mapping.offset(quantity, joint)) / scale, 2 * pi / abs(scale))
            # a sign bit of whole turns: unwrapped, the words would be magnitudes
            if word is not None and word.key == "sign_bit":
                continue
        result = unwrapped(column, period)
        if quantity == "u":
            # Registers of commands and of positions may start in different revolutions. The commands are shifted by
            # whole periods, so that their median difference from the positions is at most half a period.
            result = result - period * np.round(np.median(result - values["q", joint]) / period)
        # Signals are shifted by whole periods to a median close to 0. Only angles without a wrap remain unchanged:
        # their revolution is known.
        elif count or abs(period - 2 * pi) > 1e-6:
            offset = mapping.offset(quantity, joint)
            result = centred(result - offset, period) + offset
        if count:
            remarks.append(f"{quantity} of {joint!r} wraps at {period:.4g}: {counted(count, 'jump')} removed")
        column[:] = result
    return data, tuple(remarks)


def _without_repeats(data: np.ndarray, positions: int, mapping: LogMapping) -> Repaired:
    """Return the rows `data`, (T, C) with C columns, without repeated rows, and a message about the repeats.

    Repeats are removed if every row is written several times, or with the setting 'dropouts: dropped'; otherwise they
    are only reported. positions: number of columns of positions.
    """
    # a recording of so few rows does not show whether the arm moves or rests
    if len(data) < TUNING.jump_window:
        return data, ()
    repeats, copies = repeated_rows(data[:, 1:], positions)
    count = int(np.count_nonzero(repeats))
    # up to 2 % of repeated rows have no effect on a fit
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
    """Return the rows `data`, (T, C) with C columns, without rows that contain lost samples, outliers or stale values.

    The second result is a message that lists the removed rows. signals: quantity and joint of each column after the
    times.
    """
    outliers = np.zeros(len(data), bool)
    dropped = []
    columns = dict(zip(signals, data[:, 1:].T, strict=True))
    for (quantity, joint), values in columns.items():
        rows = outlier_rows(quantity, values)
        if ("qd", joint) in columns:
            rows |= stale_rows(quantity, values, data[:, 0], columns["q", joint], columns["qd", joint])
        # Jumps of commands are no faults, since a command may jump at any time.
        if quantity != "u" and rows.any():
            outliers |= rows
            dropped.append(f"{quantity} of {joint!r} at t = {listed_times(data[rows, 0])}")
    if not dropped:
        return data, ()
    message = f"{counted(int(outliers.sum()), 'row')} left out as dropouts: {'; '.join(dropped)}"
    return data[~outliers], (message,)


def _without_delays(data: np.ndarray, signals: Sequence[tuple[str, str]], mapping: LogMapping) -> np.ndarray:
    """Return the rows `data`, (T, C) with C columns, in which signals are shifted back by their delays in the mapping.

    Rows near the ends of a gap-free piece, for which a delayed signal was not logged, are removed.
    """
    delays = np.array([mapping.delay(*signal) for signal in signals])
    if not delays.any():
        return data
    t, moved = data[:, 0], data.copy()
    for column in np.flatnonzero(delays):
        moved[:, [1 + column]] = earlier(t, data[:, [1 + column]], delays[column])
    kept = np.zeros(len(t), bool)
    for rows in _pieces(t):
        first, last = t[rows][0] - delays.min(initial=0.0), t[rows][-1] - delays.max(initial=0.0)
        kept[rows] = (t[rows] >= first - TUNING.shortest_step) & (t[rows] <= last + TUNING.shortest_step)
    return moved[kept]


def outlier_rows(quantity: str, values: np.ndarray) -> np.ndarray:
    """Return a mask (T,) of lost samples and outliers of "q", "qd" or "tau".

    Velocities of exactly 0 are no lost samples: a joint at rest has them.
    """
    rows = is_outlier(values, smooth=quantity == "q")
    return np.asarray(rows & (values != 0)) if quantity == "qd" else rows


def stale_rows(quantity: str, values: np.ndarray, t: np.ndarray, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Return a mask (T,) of the samples of "q", "qd" or "tau" that repeat an old value although the joint moves.

    A torque that remains at the largest or smallest torque of the recording is not stale, since the drive limits the
    torque. A torque that is constant until the end of the recording is not stale, since the motor may be at rest.
    """
    if quantity == "tau":
        stale = is_stale(values, qd, 0.2 * float(np.ptp(qd)))
        return np.asarray(stale & ~np.isin(values, [values.min(), values.max(), values[-1]]))
    from scipy.integrate import cumulative_trapezoid  # imported only if needed, since the import takes long

    # If q or qd is frozen while the joint moves, the integral of qd drifts from q. Values are stale if it drifts by
    # more than 0.05 rad or m.
    return is_stale(values, cumulative_trapezoid(qd, t, initial=0) - q, 0.05)


def listed_times(t: np.ndarray) -> str:
    """Return a text that lists at most the first five of the times (T,) [s], and the number of the remaining times."""
    times = ", ".join(f"{x:.4g}" for x in t[: TUNING.listed].tolist())
    unlisted = len(t) - TUNING.listed
    return f"{times} s" + (f" and {unlisted} more" if unlisted > 0 else "")


def in_time_order(data: np.ndarray, rows: np.ndarray, layout: Layout) -> Repaired:
    """Return the rows `data`, (T, C) with C columns, with increasing times, and messages about repairs.

    Signals in separate rows are joined, and rows of another topic or publisher are removed. Rows are sorted by time,
    unless positions are then less smooth. Of several rows with equal times only the first is kept. If many of them
    differ, the resolution of the clock is too low, and evenly spaced times are reconstructed. With the setting
    `sample_rate`, the logged times are replaced by evenly spaced times.

    data: values in SI units, with times in the first column. rows: (T,) row numbers in the file, for errors. Raises
    LogError for a clock that restarts, and for times that cannot be reconstructed.
    """
    repairs: tuple[str, ...] = ()
    if is_split(data):
        data, repairs = _joined_rows(data, layout)
        rows = np.arange(len(data))
    rate, others = (
        layout.mapping.sample_rate,
        "another topic or publisher: without values, or with positions only",
    )
    left_out: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        f"of {others}": lambda x: foreign_rows(x, len(layout.joints)),
        "with a signal without a number": lambda x: np.isnan(x).any(axis=1),
        "with times far from those of all other rows": lambda x: _is_timeless(x[:, 0]) & (not rate),
    }
    for reason, find in left_out.items():
        found = find(data)
        if found.any():
            data, rows = data[~found], np.asarray(rows)[~found]
            repairs += (f"{counted(int(found.sum()), 'row')} left out, {reason}",)
    if rate:
        return np.column_stack([np.arange(len(data)) / rate, data[:, 1:]]), repairs
    if len(data) and abs(data[0, 0]) > 1e8:  # a date, if the first rows had no time
        data[:, 0] -= data[0, 0]
    t = data[:, 0]
    late = int(np.count_nonzero(np.diff(t) < 0))
    if late:
        ordered = data[np.argsort(t, kind="stable")]
        positions = slice(1, 1 + len(layout.joints))
        # If sorted positions are rougher, the clock restarted between two recordings in the file, and sorting would
        # interleave the recordings.
        if _roughness(ordered[:, positions]) > _roughness(data[:, positions]):
            raise _backward_times(t, rows, layout)
        data = ordered
        repairs += (f"{counted(late, 'time')} before that of the row above: the rows were sorted",)
    is_repeat = np.diff(data[:, 0], prepend=-np.inf) == 0
    differs = is_repeat & np.append(False, (np.diff(data[:, 1:], axis=0) != 0).any(axis=1))
    # The resolution of the clock is too low if more than ten rows, and more than 2 % of all rows, have the same time as
    # the row before but other values.
    if np.count_nonzero(differs) > max(10, 0.02 * len(data)):
        t, message = _reconstructed(data[:, 0], layout)
        return np.column_stack([t, data[:, 1:]]), (*repairs, message)
    repeats = np.count_nonzero(is_repeat)
    if repeats:
        data = data[~is_repeat]
        repairs += (f"{counted(int(repeats), 'row')} with the time of the row before left out",)
    return data, repairs


def _is_timeless(t: np.ndarray) -> np.ndarray:
    """Return a mask (T,) of the times t (T,) that are far from all others, such as 0 in a message without a stamp."""
    if len(t) < TUNING.jump_window:
        return np.zeros(len(t), bool)
    first, middle, last = np.quantile(t, [0.25, 0.5, 0.75])
    return np.asarray((np.abs(t - middle) > 1e4 * (last - first)) & (last > first))


def _joined_rows(data: np.ndarray, layout: Layout) -> Repaired:
    """Return rows (T, C) that contain all C columns, from signals that are logged in separate rows, and a message.

    The times are the times of the signal with the fewest samples. If more than 90 % of its rows contain all signals,
    the complete rows are returned. Otherwise the other signals are interpolated at these times. Rows within a gap of a
    signal, or before its first or after its last sample, are omitted.
    """
    finite = np.isfinite(data)
    base = finite[:, 1 + int(finite[:, 1:].sum(axis=0).argmin())]
    complete = finite.all(axis=1)
    if complete.sum() > 0.9 * base.sum():
        message = f"{counted(int((~complete).sum()), 'row')} without all signals left out: signals have different rates"
        return data[complete], (message,)
    order = np.argsort(data[:, 0], kind="stable")
    data, finite, base = data[order], finite[order], base[order]
    joined, mapping = data[base], layout.mapping
    times = joined[:, 0]
    for k, signal in enumerate(mapping.signals(layout.joints), start=1):
        rows = finite[:, k]
        t, values = data[rows, 0], data[rows, k]
        period = abs(mapping.scale(*signal)) * (mapping.word("period", *signal) or 0.0)
        if period:  # interpolated angles are wrong across a wrap
            values = unwrapped(values, period)
        joined[:, k] = np.interp(times, t, values, left=np.nan, right=np.nan)
        after = np.clip(np.searchsorted(t, times), 1, len(t) - 1)
        gaps = (t[after] - t[after - 1] > TUNING.gap * np.median(np.diff(t))) & ~np.isin(times, t)
        joined[gaps, k] = np.nan
    message = "signals in separate rows or messages: interpolated at the times of the rarest one"
    return joined[np.isfinite(joined).all(axis=1)], (message,)


def _reconstructed(t: np.ndarray, layout: Layout) -> tuple[np.ndarray, str]:
    """Return evenly spaced times (T,) [s] for times t (T,) of a clock with a low resolution, and a message.

    Raises LogError if a reconstructed time differs from the logged one by more than a tick of the clock.
    """
    steps = np.diff(t)
    tick = float(steps[steps > 0].min(initial=np.inf))
    # a step that is too long for the resolution of the clock is a gap; times are evenly spaced between gaps only
    holes = np.flatnonzero(steps > TUNING.gap * max(tick, float(steps.mean()))) + 1
    times, rates = t.copy(), []
    for start, stop in pairwise([0, *holes.tolist(), len(t)]):
        numbers = np.arange(stop - start)
        slope, first = np.polyfit(numbers, t[start:stop], 1) if len(numbers) > 2 else (0.0, t[start])
        times[start:stop] = first + slope * numbers
        rates.append(slope)
    if np.abs(times - t).max() > tick or not min(rates) > 0 or np.median(rates) < SIGNALS.fastest_step:
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
    """Return the roughness of positions (T, n): each joint's path length divided by its range, summed over joints."""
    ranges = np.ptp(positions, axis=0)
    length = np.abs(np.diff(positions, axis=0)).sum(axis=0)
    return float((length / np.where(ranges > 0, ranges, 1.0)).sum())


def _backward_times(t: np.ndarray, rows: np.ndarray, layout: Layout) -> LogError:
    """Return the error about times t (T,) [s] that do not increase. rows: (T,) row numbers in the file."""
    backward = np.flatnonzero(np.diff(t) < TUNING.shortest_step)
    k = backward[0]
    got = f"t = {t[k + 1]:g} s after {t[k]:g} s ({backward.size} such steps, this is the first)"
    do = "sort the rows, drop repeats, or split recordings by a column 'trajectory'"
    return layout.row_error(got, rows[k + 1], layout.columns[0], "increasing times", do)


def _pieces(t: np.ndarray) -> Iterator[slice]:
    """Yield the rows of each gap-free piece of at least two samples in the times t (T,)."""
    yield from (slice(start, stop) for start, stop in pairwise(gap_ends(t)) if stop - start > 1)


def earlier(t: np.ndarray, values: np.ndarray, delay: float) -> np.ndarray:
    """Return delayed values (T, n), sampled at times t (T,), shifted back by the delay [s].

    At the ends of a gap-free piece, the first or last value of the piece replaces values that were not logged.
    """
    if not delay:
        return values
    from scipy.interpolate import CubicSpline  # imported only if needed, since the import takes long

    moved = values.copy()
    for rows in _pieces(t):
        # A cubic spline is used, since linear interpolation would attenuate high frequencies of the torques.
        spline = CubicSpline(t[rows], values[rows])
        moved[rows] = spline(np.clip(t[rows] + delay, t[rows][0], t[rows][-1]))
    return moved
