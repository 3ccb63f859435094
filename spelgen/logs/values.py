"""Conversion of logged columns to numbers in SI units, with the URDF's signs."""

import re
from collections.abc import Sequence
from itertools import starmap
from typing import TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute

from spelgen.errors import LogError
from spelgen.logs.jumps import signed
from spelgen.logs.row_names import RowsByNames, rows_by_names
from spelgen.logs.tables import Layout, list_element, stored_names
from spelgen.logs.tuning import TUNING
from spelgen.settings.log_mapping import TIMES, mapped_unit

NUMBER = r"[+-]?\d+(?:[.,]\d*)?(?:[eE][+-]?\d+)?"
DECIMAL_COMMA = NUMBER.replace("[.,]", ",")

Rows: TypeAlias = "Sequence[int] | np.ndarray"
Column: TypeAlias = "pa.ChunkedArray | pa.Array"


def values_in_si(table: pa.Table, layout: Layout, start: pa.Scalar | None, rows: Rows) -> np.ndarray:
    """Return the C columns of a layout as numbers (T, C) in SI units.

    Absent values become NaN in rows of another topic or publisher (see `foreign_rows`), in logs whose signals are in
    separate rows (see `is_split`), and with the setting 'dropouts: dropped'. Raises LogError, with row and column, for
    values that are absent elsewhere, that are not numbers, or that are beyond the range of any arm.

    Args:
        table: the logged columns.
        layout: names of the columns, and the mapping with units, signs and offsets.
        start: logged time that becomes 0; None: times are unchanged.
        rows: (T,) row numbers in the file, for errors.
    """
    times, unit = _clock(table, layout)
    if start is not None:
        # The start time is subtracted from integer times, before the conversion to doubles: doubles near 1.7e18 ns are
        # 256 ns apart.
        times = pa.compute.subtract(times, start)
    logged = [_floats(times, layout.columns[0], layout, rows)]
    mapping, signals = layout.mapping, layout.mapping.signals(layout.joints)
    by_names = rows_by_names(table, {x: mapping.log_name(x) for x in layout.joints}, layout.file)
    for name, signal in zip(layout.columns[1:], signals, strict=True):
        values = _floats(logged_column(table, name, by_names), name, layout, rows)
        sign_bit = mapping.word("sign_bit", *signal)
        logged.append(signed(values, sign_bit) if sign_bit else values)
    factors = np.array([unit, *starmap(mapping.scale, signals)])
    offsets = np.array([0.0, *starmap(mapping.offset, signals)])
    # NumPy's warnings are suppressed: values that overflow are reported below, with their rows.
    with np.errstate(over="ignore", invalid="ignore"):
        data: np.ndarray = np.stack(logged, axis=1) * factors + offsets
    largest = np.array([TUNING.latest, *[TUNING.largest_value] * len(signals)])
    foreign = foreign_rows(data, len(layout.joints))
    bad = ~(np.abs(data) < largest)  # NaN is a bad value, too: comparisons with NaN are False
    if is_split(data):
        bad[:, 1:] &= ~np.isnan(data[:, 1:])
    elif not foreign.all():
        bad &= ~foreign[:, None]
    if layout.mapping.dropouts == "dropped" and np.isfinite(data).all(axis=1).any():
        data[np.isinf(data)] = np.nan
        bad &= ~np.isnan(data)
    if bad.any():
        first, k = np.argwhere(bad)[0]
        value, count = data[first, k], f"{bad.any(axis=1).sum()} of {len(data)} rows have such a"
        got, expected = f"{value:.3g} in SI units ({count} value", f"a number below {largest[k]:g}"
        do = "check units and gains"
        if not np.isfinite(value):
            got, expected = f"no finite number ({count} gap", "a number"
            do = "'dropouts: dropped' under 'logs' in the robot's YAML leaves out those rows"
            if not np.isfinite(data[:, k]).any():
                do = f"name a column with values in place of {layout.columns[k]} under 'logs' in the robot's YAML"
        raise layout.row_error(f"{got}, this is the first)", rows[first], layout.columns[k], expected, do)
    return data


def foreign_rows(data: np.ndarray, joints: int) -> np.ndarray:
    """Return a mask (T,) of the rows of another publisher, which contain positions only, or no values.

    Velocities and torques of such a row are absent. They may also be exactly 0, if many such rows (more than 2 %) are
    scattered between other rows.

    data: (T, 1 + C), times and C signals. joints: number of joints, whose positions are the first signals.
    """
    signals = data[:, 1 + joints :]
    empty, zero = np.isnan(signals).all(axis=1), (signals == 0).all(axis=1)
    # Rows whose velocities and torques are all 0 may be genuine in two cases. If the arm is at rest and its motors are
    # off, such rows form long runs. If a moving arm reverses and its signals are coarse, they are less than 2 % of all
    # rows. Rows of zeros count as rows of another publisher only if they are more than 2 % of all rows, in more than
    # eight runs with fewer than four rows on average.
    if signals.shape[1] > joints and zero.sum() > max(TUNING.jump_window, 0.02 * len(data)):
        runs = int(np.count_nonzero(np.diff(zero.astype(int)) > 0))
        if runs > TUNING.jump_window and zero.sum() < 4 * runs:
            empty |= zero
    return np.asarray(empty)


def is_split(data: np.ndarray) -> bool:
    """Return True if at least one of the C signals of a log (T, 1 + C) has values in at most half of the rows.

    The signals of such a log are in separate rows, which must be joined: topics have different rates, or joints are in
    different messages. The first column contains the times.
    """
    rarest = int(np.isfinite(data[:, 1:]).sum(axis=0).min(initial=len(data)))
    return TUNING.jump_window <= rarest <= len(data) / 2


def clock_start(table: pa.Table, layout: Layout) -> tuple[pa.Scalar | None, float]:
    """Return the first logged time, as logged and in seconds, if the times are dates; else (None, 0.0).

    The first time is subtracted from all times, since dates have too few digits as floating-point numbers.
    """
    first_row = table.slice(0, 1)
    times, unit = _clock(first_row, layout)
    is_stamp = pa.types.is_temporal(logged_column(first_row, layout.columns[0]).type)
    if not (pa.types.is_integer(times.type) or pa.types.is_floating(times.type)):
        return None, 0.0
    # Times since 1970 would have too few digits as floating-point numbers, so their start is subtracted. A clock that
    # starts with the recording has a first time below 1e8 in any unit.
    first = times[0].as_py()
    is_date = first is not None and (is_stamp or 1e8 < abs(first) < np.inf)
    return (times[0], first * unit) if is_date else (None, 0.0)


def _clock(table: pa.Table, layout: Layout) -> tuple[Column, float]:
    """Return the column of times as numbers, and the factor that converts these numbers to seconds.

    Raises LogError for dates beyond the range of Arrow.
    """
    name = layout.columns[0]
    times = logged_column(table, name)
    if pa.types.is_string(times.type) or pa.types.is_large_string(times.type):
        nanoseconds = _nanoseconds(times)
        if nanoseconds is not None:
            return nanoseconds, TIMES["ns"]
    if not pa.types.is_temporal(times.type):
        return times, layout.mapping.time_scale
    counted: pa.DataType = pa.timestamp("ns")
    if pa.types.is_duration(times.type):
        counted = pa.duration("ns")
    elif pa.types.is_time(times.type):
        counted = pa.time64("ns")
    try:
        return times.cast(counted).cast(pa.int64()), TIMES["ns"]
    except pa.ArrowInvalid as error:
        raise LogError(
            f"dates beyond the range of nanosecond stamps ({times.type})", file=layout.file, element=f"column {name}",
            expected="years from 1678 to 2262", do="check the unit of the stamps",
        ) from error  # fmt: skip


def _nanoseconds(texts: Column) -> pa.Array | None:
    """Return times (T,) [ns] from texts of a clock ("10:00:00.123", also with a date) or with a unit ("10 ms").

    Times of day increase by a day at midnight. Returns None for other texts.
    """
    texts = pa.compute.utf8_trim_whitespace(pa.compute.replace_substring(texts.cast(pa.string()), "µ", "u"))
    first = next((x for x in texts.slice(0, 1).to_pylist() if x), "")
    match = re.fullmatch(rf"{NUMBER} ?([a-z]+)", first)
    if match and mapped_unit("t", match[1]) in TIMES:
        groups = pa.compute.extract_regex(texts, rf"^(?P<number>{NUMBER}) ?(?P<unit>[a-z]+)$")
        numbers, units = (pa.compute.struct_field(groups, name) for name in ("number", "unit"))
        factors = [TIMES.get(mapped_unit("t", unit or "") or "", np.nan) for unit in units.to_pylist()]
        return pa.array(_numbers(numbers) * factors / TIMES["ns"])
    zone = r"(?: ?Z| ?UTC| ?[+-]\d\d:?\d\d)?$"
    clock = r"^(?P<date>\d{4}-\d\d-\d\d[T ])?(?:(?P<h>\d+):)?(?P<m>\d+):(?P<s>\d+(?:[.,]\d*)?)" + zone
    if not re.match(clock, first):
        return None
    groups = pa.compute.extract_regex(texts, clock)
    hours, minutes, seconds = (_numbers(pa.compute.struct_field(groups, name)) for name in "hms")
    times = 3600 * np.nan_to_num(hours) + 60 * minutes + seconds
    dates = pa.compute.struct_field(groups, "date").to_numpy(zero_copy_only=False)
    if dates[0]:
        days = np.array([x[:10] if x else "NaT" for x in dates], dtype="datetime64[D]")
        times = times + 86400 * days.astype(float)
    else:
        times = times + 86400 * np.cumsum(np.diff(times, prepend=times[:1]) < -43200)
    return pa.array(times / TIMES["ns"])


def _numbers(texts: Column) -> np.ndarray:
    """Return the numbers (T,) in texts with a decimal point or comma; NaN for an empty text or null."""
    texts = pa.compute.replace_substring(texts, ",", ".")
    texts = pa.compute.if_else(pa.compute.equal(texts, ""), None, texts)
    return np.asarray(texts.cast(pa.float64()).to_numpy(zero_copy_only=False))


def logged_column(table: pa.Table, name: str, by_names: RowsByNames | None = None) -> Column:
    """Return a column of a log by its name; `position[2]` is element 2 of each list in the column `position`.

    A list may also be written as text, such as "[0.1, 0.2]". A name "sec + nsec" is a time: seconds plus nanoseconds.
    If the log has no times and the mapping has a `sample_rate`, row numbers are returned as the column of times, and
    the caller converts them to times.

    by_names: result of `rows_by_names`. If the lists of joint names differ between rows, `position[2]` is the element
    with the same name in each row; it is null in rows without this name.
    """
    stored = stored_names(name, table.schema.names)
    if len(stored) != 1:
        return stamps(*map(table.column, stored)) if stored else pa.array(np.arange(len(table), dtype=float))
    element = list_element(name, table.schema.names)
    if element is None:
        return table.column(name)
    lists, index = table.column(element[0]), element[1]
    if not by_names:
        return _elements(lists, index)
    first, values = next(iter(by_names)), pa.nulls(len(table))
    joint = first[index] if index < len(first) else ""
    for names, rows in by_names.items():
        if joint in names:
            values = pa.compute.if_else(rows, _elements(lists, names.index(joint)), values)
    return values


def _elements(lists: Column, index: int) -> Column:
    """Return the element `index` of each list in a column; null for shorter lists."""
    is_text = not pa.types.is_nested(lists.type)
    if is_text:
        bare = pa.compute.replace_substring_regex(lists.cast(pa.string()), r"^.*[\[({]\s*|\s*[\])}].*$", "")
        lists = pa.compute.split_pattern_regex(bare, r"[,;\s]+")
    # Lists that are too short are replaced by null, since Arrow would raise an error for them.
    long_enough = pa.compute.greater(pa.compute.list_value_length(lists), index)
    lists = pa.compute.if_else(long_enough, lists, pa.scalar(None, lists.type))
    elements = pa.compute.list_element(lists, index)
    return pa.compute.replace_substring_regex(elements, "^$", "nan") if is_text else elements


def stamps(seconds: Column, nanoseconds: Column) -> Column:
    """Return times, as Arrow durations, from the columns of a ROS stamp: seconds, and nanoseconds in the second."""
    rounded = pa.compute.multiply(seconds.cast(pa.int64()), 1_000_000_000)
    return pa.compute.add(rounded, nanoseconds.cast(pa.int64())).cast(pa.duration("ns"))


def _floats(values: Column, name: str, layout: Layout, rows: Rows) -> np.ndarray:
    """Return the values of a column as float64 (T,).

    name: name of the column in errors. rows: (T,) row numbers in the file. Raises LogError for a value that is not a
    number.
    """
    try:
        # The cast of integers is not safe: it rounds integers beyond 2^53, such as times in ns. A safe cast would raise
        # an error.
        floats = values.cast(pa.float64(), safe=not pa.types.is_integer(values.type))
        return np.asarray(floats.to_numpy(zero_copy_only=False))
    except (pa.ArrowException, ValueError) as error:
        # The row of the first value that is no number is searched, since Arrow's error does not state it.
        texts = values.to_pylist() if pa.types.is_string(values.type) else []
        # Numbers with decimal commas are accepted. But if all of them have the form "1,234", they may be thousands: an
        # error.
        with_comma = [text for text in texts if text and "," in text]
        is_decimal = not all(re.fullmatch(r"-?[1-9]\d{0,2},\d{3}", text) for text in with_comma)
        if is_decimal and all(re.fullmatch(DECIMAL_COMMA, text) for text in texts if text):
            return _numbers(values)
        for index, text in enumerate(texts):
            if text and not is_number(text) and not (is_decimal and re.fullmatch(DECIMAL_COMMA, text)):
                do = "remove that row"
                if re.fullmatch(r"-?\d{1,3}([,.' ]\d{3})+([,.]\d*)?", text):
                    do = "write numbers without separators of thousands"
                elif name == layout.columns[0] and re.search(r"\d:\d\d", text):
                    do = "write times as numbers, or like 2025-10-26T11:59:56.123 or 11:59:56.123"
                elif re.match(NUMBER, text):
                    do = "write numbers only, and the unit as 'units' under 'logs' in the robot's YAML"
                raise layout.row_error(repr(text[:60]), rows[index], name, "a number", do) from error
        got = f"values of type {values.type}"
        raise LogError(got, file=layout.file, element=f"column {name}", expected="numbers") from error


def is_number(text: str) -> bool:
    """Return True if a text, such as a cell of a CSV file, is a number in Python's notation."""
    try:
        float(text)
    except ValueError:
        return False
    return True
