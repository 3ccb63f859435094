"""Conversion of rows in SI units to trajectories: sorting, unwrapping, removal of repeats, velocities, torque delay."""

from collections.abc import Iterator
from itertools import pairwise
from math import pi

import numpy as np

from spelgen.errors import LogError
from spelgen.labels import counted
from spelgen.logs.jumps import (
    centred,
    is_interrupted,
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

# [rad, m] If the command of a servo changes by more than this and its position does not change, the position is frozen.
COMMANDED = 0.2


class Rows:
    """Rows of one recording in SI units while they are repaired.

    Attributes:
        data: (T, C) values of the C columns of the layout; the first column contains the times [s].
        numbers: (T,) row numbers in the file, for errors.
        layout: names of the columns, and the mapping with units, signs and offsets.
        signals: quantity and joint of each column after the times.
        repairs: messages about rows that were changed or removed.
        remarks: messages about properties of the recording.
    """

    def __init__(self, data: np.ndarray, numbers: np.ndarray, layout: Layout) -> None:
        self.data, self.numbers, self.layout = data, numbers, layout
        self.signals = layout.mapping.signals(layout.joints)
        self.repairs: list[str] = []
        self.remarks = list(layout.remarks)

    @property
    def t(self) -> np.ndarray:
        """Times (T,) [s]."""
        return self.data[:, 0]

    @property
    def positions(self) -> np.ndarray:
        """Positions (T, n) [rad, m]."""
        return self.data[:, 1 : 1 + len(self.layout.joints)]

    @property
    def columns(self) -> dict[tuple[str, str], np.ndarray]:
        """{(quantity, joint): values (T,)}, which are views of the data."""
        return dict(zip(self.signals, self.data[:, 1:].T, strict=True))

    def keep(self, rows: np.ndarray) -> None:
        """Remove all rows except the rows of a mask (T,), or the rows with the given indices, in the given order."""
        self.data, self.numbers = self.data[rows], self.numbers[rows]

    def leave_out(self, rows: np.ndarray, reason: str) -> None:
        """Remove the rows of a mask (T,), if there are any, and add a message: their number and the `reason`."""
        if rows.any():
            self.keep(~rows)
            self.repairs.append(f"{counted(int(rows.sum()), 'row')} {reason}")


def make_trajectory(data: np.ndarray, numbers: np.ndarray, layout: Layout, name: str) -> Trajectory:
    """Return the trajectory of the rows `data`, (T, C) in SI units, with the C columns of the layout.

    Rows get increasing times (see `_order_in_time`). Then wrapped angles and overflowed registers are unwrapped, and
    repeated rows are removed; with the setting 'dropouts: dropped' lost rows and outliers are removed, too. At last the
    signals are shifted by the mapping's delays, and velocities that were not logged are computed by differentiation.

    numbers: (T,) row numbers in the file, for errors. Raises LogError for wrong times.
    """
    rows, mapping = Rows(data, numbers, layout), layout.mapping
    if is_split(data):
        _join_signals(rows)
    rows.leave_out(
        foreign_rows(rows.data, len(layout.joints)),
        "left out, of another topic or publisher: without values, with positions only, or with zeros",
    )
    rows.leave_out(np.isnan(rows.data).any(axis=1), "left out, with a signal without a number")
    if mapping.sample_rate:
        rows.t[:] = np.arange(len(rows.t)) / mapping.sample_rate
    else:
        _order_in_time(rows)
    _unwrap(rows)
    _leave_out_repeats(rows)
    if mapping.dropouts == "dropped":
        _leave_out_outliers(rows)
    _remove_delays(rows)
    t, count = rows.t, len(layout.joints)
    columns = np.split(rows.data[:, 1:], range(count, count * len(mapping.quantities), count), axis=1)
    logged = dict(zip(mapping.quantities, columns, strict=True))
    q = logged["q"]
    if "qd" not in logged:
        logged["qd"] = np.zeros_like(q)
        for piece in _pieces(t):
            logged["qd"][piece] = np.gradient(q[piece], t[piece], axis=0)  # qd: central difference of q
    logged.setdefault("tau", np.zeros((len(t), 0)))
    return Trajectory(
        t, **logged, name=name, file=layout.file, accepted=layout.accepted, mapping=mapping,
        repairs=tuple(rows.repairs), remarks=tuple(rows.remarks),
    )  # fmt: skip


def _unwrap(rows: Rows) -> None:
    """Unwrap the signals for which the column mapping states a period, and add remarks about the wraps."""
    mapping, columns = rows.layout.mapping, rows.columns
    for (quantity, joint), column in columns.items():
        period = mapping.period(quantity, joint)
        if not period:
            continue
        scale, offset = mapping.scale(quantity, joint), mapping.offset(quantity, joint)
        count = jump_count(column, period)
        if count and quantity == "q":
            word = read_as_words((column - offset) / scale, 2 * pi / abs(scale))
            # Register words with a separate sign bit are not unwrapped: their jumps are changes of sign and no wraps at
            # a period. A check reports such words.
            if word is not None and word.key == "sign_bit":
                continue
            # The register of a joint without limits may overflow at another period than a turn, such as 25 rad.
            if word is not None and abs(period - 2 * pi) < 1e-6:
                period = word.value * abs(scale)
        result = unwrapped(column, period)
        if quantity == "u":
            # Registers of commands and of positions may start in different revolutions. The commands are shifted by
            # whole periods, so that their median difference from the positions is at most half a period.
            result = result - period * np.round(np.median(result - columns["q", joint]) / period)
        # Measured signals are shifted by whole periods to a median close to 0, because registers start in an arbitrary
        # period. Exception: a signal with a period of one turn that never wraps is an angle, and correct as logged.
        elif count or abs(period - 2 * pi) > 1e-6:
            result = centred(result - offset, period) + offset
        if count:
            text = f"{quantity} of {joint!r} wraps at {period:.4g}: {counted(count, 'jump')} removed"
            rows.remarks.append(text)
        column[:] = result


def _leave_out_repeats(rows: Rows) -> None:
    """Remove repeated rows if every row is written several times, or with the setting 'dropouts: dropped'.

    Otherwise repeated rows are only reported.
    """
    t, samples = rows.t, len(rows.t)
    # A recording of fewer than eight rows does not show whether the arm moves or rests, so that repeats cannot be
    # recognised.
    if samples < TUNING.jump_window:
        return
    repeats, copies = repeated_rows(rows.data[:, 1:], len(rows.layout.joints))
    count = int(np.count_nonzero(repeats))
    # Up to 2 % of repeated rows are kept, since they have no effect on a fit.
    if count <= 0.02 * samples:
        return
    is_kept = copies == 1 and rows.layout.mapping.dropouts == "kept"
    message = f"{count} rows repeat the row before in motion"
    if copies > 1:
        message = f"every row is written {copies} times"
    effect = "'dropouts: dropped' under 'logs' removes them" if is_kept else "repeats were left out"
    rate = (samples - 1 - count) / (t[-1] - t[0])
    rows.repairs.append(f"{message}: {effect}, {rate:.3g} Hz remain")
    if not is_kept:
        rows.keep(~repeats)


def _leave_out_outliers(rows: Rows) -> None:
    """Remove rows that contain lost samples, outliers or stale values, with a message that lists them."""
    outliers = np.zeros(len(rows.t), bool)
    dropped, columns = [], rows.columns
    for (quantity, joint), values in columns.items():
        faulty = outlier_rows(quantity, values, columns["q", joint])
        motion = (columns.get((x, joint), np.zeros(0)) for x in ("q", "qd", "u"))
        faulty |= stale_rows(quantity, values, rows.t, *motion)
        if faulty.any():
            outliers |= faulty
            dropped.append(f"{quantity} of {joint!r} at t = {listed_times(rows.t[faulty])}")
    rows.leave_out(outliers, f"left out as dropouts: {'; '.join(dropped)}")


def _remove_delays(rows: Rows) -> None:
    """Shift each signal back by its delay in the column mapping.

    Rows near the ends of a gap-free piece, for which a delayed signal was not logged, are removed.
    """
    delays = np.array([rows.layout.mapping.delay(*signal) for signal in rows.signals])
    if not delays.any():
        return
    t, covered = rows.t, np.zeros(len(rows.t), bool)
    for column, delay in zip(rows.columns.values(), delays.tolist(), strict=True):
        column[:] = earlier(t, column, delay)
    for piece in _pieces(t):
        first, last = t[piece][0] - delays.min(initial=0.0), t[piece][-1] - delays.max(initial=0.0)
        margin = TUNING.shortest_step
        covered[piece] = (t[piece] >= first - margin) & (t[piece] <= last + margin)
    rows.keep(covered)


def outlier_rows(quantity: str, values: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return a mask (T,) of lost samples and outliers in a signal `values` (T,) of one joint.

    A lost sample is a 0 between values far from 0. Velocities of exactly 0 are no lost samples: a joint at rest has
    them. Genuine commands may jump, or be 0 in successive samples. Commands are therefore removed from the mask if they
    are 0 next to another 0, or if their distance from the position is at most twice the largest such distance of the
    commands outside the mask.

    quantity: "q", "qd", "tau" or "u". q: (T,) positions of the joint [rad, m].
    """
    rows = is_outlier(values, smooth=quantity == "q")
    if quantity == "u" and rows.any():
        present = np.pad(values != 0, 1, constant_values=True)
        distance = np.abs(values - q)
        rows &= present[1:-1] | (present[:-2] & present[2:])
        rows &= distance > 2 * distance[~rows].max(initial=0.0)
    return np.asarray(rows & (values != 0)) if quantity == "qd" else rows


def stale_rows(
    quantity: str, values: np.ndarray, t: np.ndarray, q: np.ndarray, qd: np.ndarray, u: np.ndarray
) -> np.ndarray:
    """Return a mask (T,) of the samples of a signal that repeat an old value although the joint moves.

    Two kinds of constant torque are not stale. A torque equal to the largest or smallest torque of the recording may be
    limited by the drive. A torque equal to the torque of the last sample may be that of a motor that was switched off;
    the joint is then at rest in the last half of these samples.

    Args:
        quantity: name of the signal, "q", "qd", "tau" or "u". Commands are never stale.
        values: (T,) the signal of one joint.
        t: (T,) times [s].
        q: (T,) positions of the joint [rad, m].
        qd: (T,) velocities of the joint [rad/s, m/s]; empty if they were not logged.
        u: (T,) commanded positions of the joint [rad, m]; empty for joints without position servo.
    """
    # Stale blocks have more than 20 samples (see `is_stale`), so shorter recordings have none. Returning here saves
    # time in data sets of thousands of short recordings.
    if len(t) <= 20:
        return np.zeros(len(t), bool)
    if u.size:
        # `margin`: positions lag behind their commands by less than 0.25 s. `COMMANDED` is above 0.13 rad, because dry
        # friction may hold servos of an SO-101 at rest while their commands change by up to 0.13 rad.
        margin = round(0.25 / max(float(np.median(np.diff(t))), 1e-3))
        return is_stale(values, u, COMMANDED, margin) if quantity == "q" else np.zeros(len(t), bool)
    sound = ~is_outlier(q, smooth=True)
    q = np.interp(t, t[sound], q[sound])  # an outlier is no motion
    if quantity == "tau":
        speed = qd if qd.size else np.gradient(q, t)
        change = 0.2 * float(np.ptp(speed))
        last = np.flatnonzero(values == values[-1])
        off = [values[-1]] if np.ptp(speed[last[len(last) // 2 :]]) < change else []
        stale = is_stale(values, speed, change)
        return stale & ~np.isin(values, [values.min(), values.max(), *off])
    stale = is_interrupted(t, q) & (quantity == "q")
    # If q or qd is frozen while the joint moves, the difference between q and the integral of qd changes. A block of
    # equal values is stale if this difference changes by more than 0.05 rad or m within the block.
    return stale | is_stale(values, travel(t, qd) - q, 0.05) if qd.size else stale


def travel(t: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Return the integral of velocities qd (T,) [rad/s, m/s] over the times t (T,) [s], as positions (T,) [rad, m].

    Velocities whose mean over 0.1 s is at most three quantisation steps, and at most 0.05 rad/s or m/s, count as zero:
    the registers of some drives have no word for zero, so a joint at rest has noise around half a step, whose integral
    grows with time.
    """
    from scipy.integrate import cumulative_trapezoid  # SciPy is slow to import, so it is imported only here
    from scipy.ndimage import uniform_filter1d

    step = np.diff(np.unique(qd)).min(initial=np.inf)
    window = max(1, round(0.1 / max(float(np.median(np.diff(t))), 1e-4))) if len(t) > 1 else 1
    at_rest = np.abs(uniform_filter1d(qd, window)) <= min(3 * step, 0.05)
    return np.asarray(cumulative_trapezoid(np.where(at_rest, 0.0, qd), t, initial=0))


def listed_times(t: np.ndarray) -> str:
    """Return a text that lists at most the first five of the times (T,) [s], and the number of the remaining times."""
    times = ", ".join(f"{x:.4g}" for x in t[: TUNING.listed].tolist())
    unlisted = len(t) - TUNING.listed
    return f"{times} s" + (f" and {unlisted} more" if unlisted > 0 else "")


def _order_in_time(rows: Rows) -> None:
    """Sort the rows by time and remove or correct equal times; a message is added about each repair.

    If sorting makes the positions less smooth, the clock was set back: the rows keep their order, and the times are
    made continuous. Of several rows with equal times only the first is kept. If many rows have the time of the row
    before but other values, the resolution of the clock is too low: all rows are kept, and evenly spaced times are
    reconstructed. Raises LogError if the clock restarts without a continued motion, if it counts down (the velocities
    are then opposite to dq/dt after sorting), and for times that cannot be reconstructed.
    """
    rows.leave_out(_is_timeless(rows.t), "left out, with times far from those of all other rows")
    # Times that are dates (seconds since 1970) are converted to seconds since the first row with a time. The reader of
    # the file has already done this, unless the first row of the file has no time.
    if len(rows.t) and abs(rows.t[0]) > 1e8:
        rows.t[:] -= rows.t[0]
    late = int(np.count_nonzero(np.diff(rows.t) < 0))
    if late:
        order = np.argsort(rows.t, kind="stable")
        message = f"{counted(late, 'time')} before that of the row above: the rows were sorted"
        # If positions are rougher after sorting, the clock restarted in the file. If the motion continues at the
        # restart, the clock was set back, or its counter overflowed. If the motion does not continue, the file has
        # several recordings, which sorting would interleave.
        if 2 * late > len(rows.t):
            # Most times are before the time of the row above. Either the rows are in reverse order, or the clock counts
            # down (remaining time). The logged velocities decide: in the first case they agree with dq/dt of the sorted
            # rows. In the second case they have the opposite sign of dq/dt, and sorting would reverse the motion.
            joints, quantities = len(rows.layout.joints), rows.layout.mapping.quantities
            velocities = (
                rows.data[order, 1 + joints : 1 + 2 * joints] if "qd" in quantities else np.zeros((2, 1))
            )
            if np.nansum(np.diff(rows.positions[order], axis=0) * velocities[1:]) < 0:
                raise _backward_times(rows)
            rows.keep(order)
        elif _roughness(rows.positions[order]) > _roughness(rows.positions):
            if not _continues(rows):
                raise _backward_times(rows)
            steps = np.diff(rows.t)
            steps[steps < 0] = np.median(steps)
            rows.t[1:] = rows.t[0] + np.cumsum(steps)
            message = (
                f"the clock went back {counted(late, 'time')} while the motion continued: times were joined"
            )
        else:
            rows.keep(order)
        rows.repairs.append(message)
    is_repeat = np.diff(rows.t, prepend=-np.inf) == 0
    differs = is_repeat & np.append(False, (np.diff(rows.data[:, 1:], axis=0) != 0).any(axis=1))
    # The resolution of the clock is too low if more than ten rows, and more than 2 % of all rows, have the same time as
    # the row before but other values.
    if np.count_nonzero(differs) > max(10, 0.02 * len(differs)):
        rows.t[:], message = _reconstructed(rows.t, rows.layout)
        rows.repairs.append(message)
        return
    rows.leave_out(is_repeat, "with the time of the row before left out")


def _is_timeless(t: np.ndarray) -> np.ndarray:
    """Return a mask (T,) of the times t (T,) that are far from all others, such as 0 in a message without a stamp."""
    if len(t) < TUNING.jump_window:
        return np.zeros(len(t), bool)
    first, middle, last = np.quantile(t, [0.25, 0.5, 0.75])
    return np.asarray((np.abs(t - middle) > 1e4 * (last - first)) & (last > first))


def _join_signals(rows: Rows) -> None:
    """Join signals that are logged in separate rows to rows that contain all signals.

    The joined rows have the times of the signal with the fewest samples. If more than 90 % of the rows of this signal
    contain all signals, only the complete rows are kept. Otherwise the other signals are interpolated at these times.
    Joined rows within a gap of any signal, or before its first or after its last sample, are omitted.
    """
    data, mapping = rows.data, rows.layout.mapping
    finite = np.isfinite(data)
    base = finite[:, 1 + int(finite[:, 1:].sum(axis=0).argmin())]
    complete = finite.all(axis=1)
    if complete.sum() > 0.9 * base.sum():
        rows.leave_out(
            ~complete, "without all signals left out: of other joints, or signals have different rates"
        )
        return
    order = np.argsort(data[:, 0], kind="stable")
    data, finite, base = data[order], finite[order], base[order]
    joined = data[base]
    times = joined[:, 0]
    for k, signal in enumerate(rows.signals, start=1):
        t, values = data[finite[:, k], 0], data[finite[:, k], k]
        period = mapping.period(*signal)
        if period:  # Angles are unwrapped first: interpolation across a wrap would be wrong.
            values = unwrapped(values, period)
        joined[:, k] = np.interp(times, t, values, left=np.nan, right=np.nan)
        following = np.clip(np.searchsorted(t, times), 1, len(t) - 1)
        gaps = (t[following] - t[following - 1] > TUNING.gap * np.median(np.diff(t))) & ~np.isin(times, t)
        joined[gaps, k] = np.nan
    rows.data = joined[np.isfinite(joined).all(axis=1)]
    rows.numbers = np.arange(len(rows.data))
    rows.repairs.append("signals in separate rows or messages: interpolated at the times of the rarest one")


def _reconstructed(t: np.ndarray, layout: Layout) -> tuple[np.ndarray, str]:
    """Return evenly spaced times (T,) [s] in place of times t (T,) of a clock with a low resolution, and a message.

    A tick of the clock is its smallest time step. Raises LogError if a reconstructed time differs from the logged time
    by more than a tick, or if the reconstructed times are implausible.
    """
    steps = np.diff(t)
    tick = float(steps[steps > 0].min(initial=np.inf))
    # Times are evenly spaced between gaps. A gap is a time step longer than `TUNING.gap` ticks of the clock and longer
    # than `TUNING.gap` mean steps: the low resolution of the clock does not explain such a step.
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
    """Return the roughness of positions (T, n): the path length of a joint divided by its range, summed over joints.

    Rows in a wrong order are rougher than rows in the order of time.
    """
    ranges = np.ptp(positions, axis=0)
    length = np.abs(np.diff(positions, axis=0)).sum(axis=0)
    return float((length / np.where(ranges > 0, ranges, 1.0)).sum())


def _continues(rows: Rows) -> bool:
    """Return True if the motion is continuous at each row at which the time steps back, so that the clock was set back.

    The motion is continuous at such a row if a joint moves in the rows around it, and if no position changes by more
    than twice its largest change in the rows around it. If the time steps forward by a gap and then back, a single time
    is wrong and the clock was not set back: False is returned.
    """
    changes, steps = np.abs(np.diff(rows.positions, axis=0)), np.diff(rows.t)
    if len(changes) < 2 * TUNING.jump_window:
        return False
    for row in np.flatnonzero(steps < 0).tolist():
        if row and steps[row - 1] > TUNING.gap * np.median(steps):
            return False
        around = slice(max(0, row - TUNING.jump_window), row + TUNING.jump_window + 1)
        largest = np.delete(changes[around], row - around.start, axis=0).max(axis=0, initial=0.0)
        if (changes[row] > 2 * largest + SIGNALS.rest_range).any() or largest.max() < SIGNALS.rest_range:
            return False
    return True


def _backward_times(rows: Rows) -> LogError:
    """Return the error about the first row whose time is not later than the time of the row before."""
    t, backward = rows.t, np.flatnonzero(np.diff(rows.t) < TUNING.shortest_step)
    k = backward[0]
    got = f"t = {t[k + 1]:g} s after {t[k]:g} s ({counted(backward.size, 'such step')}, this is the first)"
    clock = rows.layout.columns[0]
    do = f"number the recordings, in Python: log['trajectory'] = (log['{clock}'].diff() < 0).cumsum()"
    if 2 * backward.size > len(t):
        got = f"times that fall from {t[0]:g} s to {t[-1]:g} s, such as the time that remains"
        do = "write 'sample_rate: HZ' under 'logs' in the robot's YAML if the rows are evenly spaced"
    return rows.layout.row_error(got, rows.numbers[k + 1], clock, "increasing times", do)


def _pieces(t: np.ndarray) -> Iterator[slice]:
    """Yield a slice of rows for each gap-free piece of at least two samples in the times t (T,) [s]."""
    yield from (slice(start, stop) for start, stop in pairwise(gap_ends(t)) if stop - start > 1)


def earlier(t: np.ndarray, values: np.ndarray, delay: float) -> np.ndarray:
    """Return a logged signal without its delay, (T, ...): the returned value at time t was logged at t + delay.

    A positive delay [s] means that the signal was logged later than it occurred. Near the ends of a gap-free piece,
    where t + delay is outside the piece, the first or last value of the piece is returned.

    t: times of the samples (T,) [s]. values: logged signal (T, ...).
    """
    if not delay:
        return values
    from scipy.interpolate import CubicSpline  # SciPy is slow to import, so it is imported only here

    moved = values.copy()
    for rows in _pieces(t):
        # A cubic spline is used, since linear interpolation would attenuate high frequencies of the torques.
        spline = CubicSpline(t[rows], values[rows])
        moved[rows] = spline(np.clip(t[rows] + delay, t[rows][0], t[rows][-1]))
    return moved
