"""Draft of the mapping of a log's columns to quantities and joints, from the names and first values of the columns.

Units are derived from the column names, and the unit of times also from the time steps. Unknown units are assumed to be
SI units: the checks of logs then detect degrees, for example, and state the settings to write.
"""

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from spelgen.errors import LogError, shortened
from spelgen.labels import listed
from spelgen.logs.bags import logged_names, names_in_log
from spelgen.logs.column_names import (
    COMMANDED,
    CURRENT,
    OTHERS,
    ColumnName,
    abbreviated_names,
    best_signal,
    columns_by_joint,
    columns_by_quantity,
    complete_signals,
    parse_column_name,
    require_one_arm,
)
from spelgen.logs.formats import BAG, LEROBOT, format_of
from spelgen.logs.parquet_files import dataset_motors
from spelgen.logs.row_names import first_list, rows_by_names
from spelgen.logs.tables import JOINTS_KEY, SERVO_ADVICE, joint_patterns, reading, stated_units, stored_names
from spelgen.logs.tuning import TUNING
from spelgen.logs.unit_checks import time_unit
from spelgen.logs.values import logged_column
from spelgen.settings.log_mapping import CURRENTS, LogMapping, mapped_unit

JOINING = "join files with a signal each in Python: {}.to_csv('log.csv', index=False)"
BY_TIME = "pandas.read_csv(FILE).merge(pandas.read_csv(OTHER), on={!r}, suffixes=('_q', '_tau'))"
BY_ROW = "pandas.read_csv(FILE).join(pandas.read_csv(OTHER), lsuffix='_q', rsuffix='_tau')"
MOTORS = (
    "# LeRobot stores degrees (units: {q: deg}) or -100..100 (units: {q: normalised}, and a calibration)."
)


class Suggestion(NamedTuple):
    """Draft of a column mapping as YAML text with comments on its assumptions. missing: quantities without a column."""

    text: str
    missing: tuple[str, ...]


ByJoint = Mapping[str, Mapping[str, ColumnName]]


def suggest_mapping(file: Path, joints: Sequence[str], *, commands: bool = False) -> Suggestion:
    """Return a draft of the column mapping for a log file, from the names and first values of its columns.

    commands: True if the log contains commanded positions instead of torques. Raises LogError for a file that cannot be
    read, has joint names in a column, has positions of several arms, or has no positions but only torques or only
    commands. If `commands` is False, LogError is also raised for a file without torques that has commanded
    positions, or only times, positions and velocities.
    """
    log_format = format_of(file)
    if log_format is LEROBOT:
        return _mapping_of_names(file, joints, dataset_motors(file), MOTORS)
    if log_format is BAG:
        return _mapping_of_names(file, joints, logged_names(file))
    assert log_format is not None, "log_files gives logs alone"
    with reading(file):
        table = log_format.read(file, (), LogMapping())[0].read(None)
    return _table_mapping(table, file, joints, commands)


def _names_signals(values: Sequence[object], joints: int) -> bool:
    """Return True if the values of a column name the joint or the signal to which the other values of a row belong.

    In such a column, neighbouring rows differ, and each value occurs equally often. joints: number of joints.
    """
    counts = Counter(values).values()
    is_cycle = 1 < joints <= len(counts) <= len(values) / 2 and max(counts) - min(counts) <= 1
    return is_cycle and all(x != y for x, y in pairwise(values))


def _table_mapping(table: pa.Table, file: Path, joints: Sequence[str], commands: bool) -> Suggestion:
    """Return the draft of the column mapping for a table of the log `file`; for `commands` see `suggest_mapping`."""
    # Of rows with different lists of joint names, such as rows of two arms, only rows with the arm's list are used.
    for rows in list(rows_by_names(table, dict(zip(joints, joints, strict=True)), file).values())[:1]:
        table = table.filter(rows)
    dates = {field.name: {"time"} for field in table.schema if pa.types.is_temporal(field.type)}
    names, stated = _names(table), stated_units(table.schema)
    labels = joint_patterns(joints, names)
    columns = [parse_column_name(x, labels, stated.get(x, ""), dates.get(x, set())) for x in names]
    arm = set.intersection(*(set(re.findall(r"[^\W\d_]+", x.lower())) for x in joints))
    if not commands:
        columns = _with_letters(_with_states(columns, table, len(joints)), table)
    columns_of = columns_by_quantity(columns, commands, len(joints))
    # A column named "load" does not count as torque here, since servos have a register with this name.
    torques = [x for x in columns_of.get("tau", ()) if "load" not in x.words]
    commanded = columns_by_quantity(columns, True, len(joints))["u"]
    if not (commands or torques) and len(commanded) >= len(joints):
        raise LogError("commanded positions and no torques", file=file, expected="torques", do=SERVO_ADVICE)
    # Constant columns are omitted: they may belong to a second arm that is at rest.
    moving = _changing(columns_of["q"], table)
    require_one_arm(moving, len(joints), arm, file)
    clocks = columns_of.pop("t")
    clock = _clock(clocks, columns, table)
    # If there are more numbered columns than joints, the changing columns belong to the arm, and the constant columns
    # before or after them to a base or gripper at rest. A base at rest has seven positions, but six velocities and
    # torques. A constant column between changing ones is a joint of the arm at rest.
    moved = {x.number for x in best_signal(moving, len(joints), arm)}
    numbers = sorted({x.number for x in columns_of["q"]})
    runs = [set(numbers[k : k + len(joints)]) for k in range(len(numbers) - len(joints) + 1)]
    listed_columns = dict(columns_of)
    if moved in runs:
        count = len(columns_of["q"])
        for quantity, named in columns_of.items():
            complete = (
                [x for x in named if x.number in moved] if len(named) == count else _changing(named, table)
            )
            columns_of[quantity] = complete if len({x.number for x in complete}) == len(moved) else named
    # The order of numbered columns may differ from the order of the arm's joints: ROS often sorts joints by name. If
    # cells of the log contain joint names, they state the order.
    order = _order_in_cells(table, joints)
    signals = {x: best_signal(named, len(joints), arm) for x, named in columns_of.items()}
    by_joint = {x: columns_by_joint(named, joints, order) for x, named in signals.items()}
    used = {clock.name, *(column.name for named in by_joint.values() for column in named.values())}
    if not by_joint["q"]:
        _require_joints_in_columns(table, [x.name for x in columns if x.quantity is None], len(joints), file)
        repeated = [x for x, count in Counter(table.column_names).items() if count > 1]
        if repeated:
            got = f"the same name for several columns: {shortened(repeated, TUNING.listed)}"
            raise LogError(got, file=file, expected="a name for each", do=f"number them: {repeated[0]}1, ...")
    absent = [word for x, word in (("q", "positions"), ("tau", "torques")) if by_joint.get(x) == {}]
    if absent and used.issuperset(x.name for x in columns):
        expected = "all signals of a recording in one file"
        got = f"no {listed(absent)} in addition to its other columns"
        join = BY_TIME.format(clock.name) if clock.name else BY_ROW
        raise LogError(got, file=file, expected=expected, do=JOINING.format(join))
    # A mapping has columns of velocities for all joints or for none. If the velocities of a joint are absent, all
    # velocities are computed from positions.
    if not commands and len(by_joint["qd"]) < len(joints):
        del by_joint["qd"]
    unit_of_times = mapped_unit("t", clock.unit) or _unit_of_times(clock.name, table) or "s"
    lines = _mapping_lines(file.name, joints, by_joint, clock, unit_of_times)
    # Comments of the draft list unused columns, for example of a gripper, or of another arm with similar names.
    used |= set(clock.name.split(" + "))
    listed_columns = {"t": clocks} | {x: listed_columns[x] for x in by_joint}
    unused = {x: [y.name for y in named if y.name not in used] for x, named in listed_columns.items()}
    unused = {x: abbreviated_names(y) for x, y in unused.items()}
    lines += [f"# not used for {x}: {shortened(y, TUNING.listed)}" for x, y in unused.items() if y]
    stated_by = {**by_joint, "t": {"": clock}}
    pairs = sorted({(x, column.unit) for x, named in stated_by.items() for column in named.values()})
    lines += [f"# not a known unit of {x}: {unit}" for x, unit in pairs if unit and not mapped_unit(x, unit)]
    missing = [f"{x} of {joint}" for joint in joints for x, named in by_joint.items() if joint not in named]
    lines += [f"# no column was found for {name}" for name in missing]
    return Suggestion("\n".join([*lines, ""]), tuple(missing))


def _mapping_lines(
    file: str, joints: Sequence[str], by_joint: ByJoint, clock: ColumnName, unit_of_times: str
) -> list[str]:
    """Return the lines of a mapping for the log named `file`: its clock, its units, and the columns of each joint.

    clock: column of the times, with the name "" if there is none. by_joint: {quantity: {joint: column}}.
    """
    units = _units(by_joint, joints)
    # Units that all joints have are stated once.
    common = {"t": unit_of_times} | dict(sorted(set.intersection(*(set(x.items()) for x in units.values()))))
    rate = "sample_rate: # [Hz] of the rows, which have no times: write its value"
    is_divided = any("{trajectory}" in x.name for x in by_joint["q"].values())
    lines = [
        f"# Drafted from the column names of {json.dumps(file)}: check it, and the order of the joints.",
        *(["# {trajectory}: number of each recording of this arm, in the names of its arrays"] * is_divided),
        f"columns: {{t: {json.dumps(clock.name)}}}" if clock.name else rate,
        f"units: {json.dumps(common)}",
    ]
    if "tau" in by_joint and "qd" not in by_joint:
        lines.append("velocity: differentiated")
    if any(x.words & COMMANDED for x in by_joint.get("tau", {}).values()):
        lines.append("# tau: commanded torques, since no others were logged")
    return [*lines, "joints:", *chain(*(_joint_lines(x, by_joint, units[x], common) for x in joints))]


def _with_states(columns: Sequence[ColumnName], table: pa.Table, joints: int) -> list[ColumnName]:
    """Return the columns; columns of a state [q; qd], such as x0, x1, ..., get the quantities "q" and "qd".

    The names of a state's columns do not state their quantities. n = `joints` columns are positions and the next n are
    velocities if the correlation of the velocities with the derivatives of the positions is above 0.9.
    """
    unstated = [x for x in columns if x.number >= 0 and not x.words & (COMMANDED | OTHERS)]
    unstated = [x for x in unstated if x.quantity in ("q", None)]
    quantity = {}
    for state in complete_signals(unstated, 2 * joints).values():
        ordered = sorted(state, key=lambda x: x.number)
        pairs = list(zip(ordered[:joints], ordered[joints:], strict=False))
        if len(state) == 2 * joints and _similarity(pairs, table)[0] > 0.9:
            for q, qd in pairs:
                quantity[q.name] = q._replace(quantity="q", words={"q"})
                quantity[qd.name] = qd._replace(quantity="qd", words={"qd"}, number=q.number)
    return [quantity.get(x.name, x) for x in columns]


def _similarity(pairs: Sequence[tuple[ColumnName, ColumnName]], table: pa.Table) -> tuple[float, float]:
    """Return two similarities of columns x, of an unknown quantity, to columns q of positions.

    The first is the correlation of x with the derivative of q: it is near 1 if x is a velocity. The second is the
    distance std(x - q) / std(q): it is small if x is a commanded position. Both are medians over the pairs (q, x) in
    which both columns change; NaN if there is no such pair.
    """
    values = [(_numbers(table, q.name), _numbers(table, x.name)) for q, x in pairs]
    moving = [(q, x) for q, x in values if len(q) == len(x) > 2 and np.ptp(q) * np.ptp(x) > 0]
    slopes = [np.corrcoef(np.gradient(q), x)[0, 1] for q, x in moving] or [np.nan]
    return float(np.median(slopes)), float(
        np.median([np.std(x - q) / np.std(q) for q, x in moving] or [np.nan])
    )


def _with_letters(columns: Sequence[ColumnName], table: pa.Table) -> list[ColumnName]:
    """Return the columns, with quantities for ambiguous names such as `t0`, `v0` and `u0`, derived from their values.

    A name has a letter and a number. Its values are compared with the position column of the same number; without such
    a column it gets no quantity. A quantity that other columns already have is not assigned. Letters mean:

    - `t`: torque.
    - `v`: velocity if its correlation with the derivative of the position is above 0.9; otherwise none.
    - `u`: velocity if this correlation is above 0.9. Otherwise torque if it differs from the position by more than 0.3
      standard deviations of the position; a smaller difference shows a commanded position, which gets no quantity here.
    """
    result = list(columns)
    positions = [x for x in columns if x.quantity == "q" and not x.words & COMMANDED]
    of_number = {x.number: x for x in positions if x.number >= 0}
    for letter in "tvu":
        named = [k for k, x in enumerate(result) if x.words == {letter} and x.number in of_number]
        slope, distance = _similarity([(of_number[result[k].number], result[k]) for k in named], table)
        if np.isnan(slope):
            continue
        quantity = "tau" if letter == "t" or (letter == "u" and distance > 0.3) else None
        if letter != "t" and slope > 0.9:
            quantity = "qd"
        # A quantity that the log already has is not assigned again: if there are torques, `t0` may be a temperature.
        present = {x.quantity for x in result if not x.words & (COMMANDED | OTHERS)}
        for k in named if quantity and quantity not in present else ():
            result[k] = result[k]._replace(quantity=quantity, words={str(quantity)})
    return result


def _require_joints_in_columns(table: pa.Table, names: Sequence[str], joints: int, file: Path) -> None:
    """Raise LogError for a log in long format: a row per time and joint, or per time and signal, not a row per time.

    In such a log one of the columns `names` states the joint or the signal of each row. Its values repeat in cycles,
    with at least as many different values as there are `joints` (see `_names_signals`). file: path of the log, for the
    error.
    """
    for name in names:
        if name in table.column_names and _names_signals(table[name].to_pylist(), joints):
            do = (
                f"in Python: wide = log.pivot(index=TIME, columns={name!r}); "
                "wide.columns = [f'{x}_{y}' for x, y in wide.columns]"
            )
            got = f"joints in the column {name!r}"
            raise LogError(got, file=file, expected="all joints in each row", do=do)


def _changing(columns: Sequence[ColumnName], table: pa.Table) -> list[ColumnName]:
    """Return the columns whose values are not all the same."""
    return [x for x in columns if len(set(_numbers(table, x.name).tolist())) > 1]


def _clock(clocks: Sequence[ColumnName], columns: Sequence[ColumnName], table: pa.Table) -> ColumnName:
    """Return the column of times, the best of the candidates ``clocks``; a column named "" if the log has no times.

    Without candidates, a column whose values rise by regular steps is returned. If the column contains whole seconds,
    and another of all ``columns`` contains the nanoseconds, the returned name is "SEC + NSEC".
    """
    # Of several columns of times, the best is searched in this order: (1) the stamp in a message header, since other
    # times may be times of receipt and not of measurement, (2) a column that does not count the rows, (3) the column
    # whose name has the fewest words, (4) the column with the most regular time steps.
    nanoseconds = [x for x in columns if re.search(r"n(?:anos|(?:ano)?sec(?:ond)?s?)$", x.name.lower())]
    seconds = [x for x in clocks if x not in nanoseconds]
    if not seconds:
        seconds = [x for x in columns if not (x.quantity or x.joint) and _is_rising(_numbers(table, x.name))]
    is_counter = {x.name: bool((np.diff(_numbers(table, x.name)) == 1).all()) for x in seconds}
    clock = min(
        seconds,
        key=lambda x: ("header" not in x.words, is_counter[x.name], len(x.words), _jitter(table, x)),
        default=ColumnName("", set(), "s"),
    )
    times = _numbers(table, clock.name)
    # If times are whole numbers that repeat, they are the seconds of a stamp, and its nanoseconds are in another
    # column.
    is_whole = (times == np.round(times)).all() and len(set(times.tolist())) < len(times)
    if not nanoseconds or not is_whole:
        return clock
    stem = re.sub(r"sec(?:ond)?s?$", "", clock.name)
    fraction = next((x for x in nanoseconds if x.name.startswith(stem)), nanoseconds[0])
    return ColumnName(f"{clock.name} + {fraction.name}", clock.words, "s")


def _jitter(table: pa.Table, column: ColumnName) -> float:
    """Return the standard deviation of the time steps in a column, relative to their median."""
    steps = np.diff(_numbers(table, column.name).astype(float))
    return float(np.std(steps) / max(np.median(steps), 1e-300)) if steps.size else np.inf


def _is_rising(values: np.ndarray) -> bool:
    """Return True if the values (T,) of a column rise by regular steps that are plausible as time between samples.

    A counter of rows rises by one in each row, and is no clock.
    """
    steps = np.diff(values)
    if len(steps) < 2 or (steps <= 0).any() or (steps == 1).all():
        return False
    middle = float(np.median(steps))
    return bool(np.mean(np.abs(steps - middle) < middle / 2) > 0.9 and time_unit(middle))


def _numbers(table: pa.Table, name: str) -> np.ndarray:
    """Return the numbers of the column `name`, such as "q", "q[2]" (item 2 of lists) or "sec + nsec", without nulls.

    The result is empty if the table has no such column, or its values are no numbers.
    """
    is_stored = name and stored_names(name, table.column_names)
    values = logged_column(table, name).drop_null() if is_stored else pa.chunked_array([[]])
    is_numeric = pa.types.is_integer(values.type) or pa.types.is_floating(values.type)
    return np.asarray(values.to_numpy()) if is_numeric else np.zeros(0)


def _joint_lines(
    joint: str, by_joint: ByJoint, units: Mapping[str, str], common: Mapping[str, str]
) -> Iterator[str]:
    """Yield the YAML lines of a joint: its columns and units, and conversions whose values the user must insert.

    by_joint: {quantity: {joint: column}}. units: {quantity: unit} of the joint. common: {quantity: unit} of the units
    that all joints share; they are not repeated here.
    """
    entries = {quantity: named[joint].name for quantity, named in by_joint.items() if joint in named}
    yield from (f"  {json.dumps(joint)}:", f"    columns: {json.dumps(entries)}")
    differing = {x: unit for x, unit in units.items() if x not in common}
    if differing:
        yield f"    units: {json.dumps(differing)}"
    unit = units.get("tau", "").rpartition(" ")[2]
    if unit in CURRENTS:
        yield f"    gain: 1.0 # Nm per {unit} at the joint, the gear included: write its value"
    if units.get("q") == "counts":
        yield "    counts_per_turn: 4096 # of the joint, the gear included: write its value"


def _mapping_of_names(log: Path, joints: Sequence[str], logged: Sequence[str], *comments: str) -> Suggestion:
    """Return a draft of the mapping for a log that has joints or motors with these names, and no columns to choose."""
    name_of = names_in_log({x: x for x in joints}, logged)
    lines = [
        f"# Drafted from the names of joints in {json.dumps(log.name)}: check it.",
        *comments,
        "joints:",
        *(f"  {json.dumps(joint)}: {{name: {json.dumps(name)}}}" for joint, name in name_of.items()),
    ]
    missing = [f"q of {joint}" for joint in joints if joint not in name_of]
    lines += [f"# no name was found for {name}" for name in missing]
    return Suggestion("\n".join([*lines, ""]), tuple(missing))


def _units(by_joint: ByJoint, joints: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return {joint: {quantity: unit}} from the stated units of columns; joints without a known unit have {}.

    A column states its unit in its name or in a line below the header. If it does not, velocities have the unit of the
    positions per second, and torques whose column name has a word for currents have the unit A. by_joint: {quantity:
    {joint: column}}.
    """
    units: dict[str, dict[str, str]] = {joint: {} for joint in joints}
    for quantity, named in by_joint.items():
        for joint, column in named.items():
            unit = mapped_unit(quantity, column.unit)
            if not column.unit and quantity == "qd" and "q" in units[joint]:
                unit = f"{units[joint]['q']}/s"
            if unit is None and quantity == "tau" and column.words & CURRENT:
                unit = "A"
            # Commands have the unit of the positions unless another unit is stated, so an equal unit is omitted.
            if unit is not None and (quantity != "u" or unit != units[joint].get("q")):
                units[joint][quantity] = unit
    return units


def _unit_of_times(name: str, table: pa.Table) -> str | None:
    """Return the unit in which the median time step of a column is plausible for a log; None if there is none."""
    times = _numbers(table, name)
    steps = np.diff(times)
    # Windows counts ticks of 100 ns since the year 1601, and .NET since the year 1. 3.2e14 ticks are 1.014 years, so
    # dates from the year 2000 on are above 394 times 3.2e14 ticks (399 years) or 1972 times 3.2e14 ticks (1999 years).
    # The upper bounds are 81 years later.
    if times.size and any(low < times[0] / 3.2e14 < low + 80 for low in (394, 1972)):
        return "0.1 us"
    return time_unit(float(np.median(steps[steps > 0]))) if (steps > 0).any() else None


def _order_in_cells(table: pa.Table, joints: Sequence[str]) -> dict[str, int]:
    """Return {joint: the number in the names of its columns}, such as 2 for the columns `q[2]` and `q2`.

    Joint names in the first row of the log state the numbers: in cells of columns `name0`, `name1`, ..., or in a list.
    Example: "elbow" in the column `name2`, or as item 2 of a list, gives {"elbow": 2}. Joints without a name in the log
    are omitted.
    """
    listed_names = json.loads((table.schema.metadata or {}).get(JOINTS_KEY, "[]"))
    order = {name: position for position, name in enumerate(listed_names) if name in joints}
    for name, column in zip(table.schema.names, table.columns if len(table) else (), strict=False):
        numbers, first = re.findall(r"\d+", name), column[0].as_py()
        for position, text in enumerate(first_list(column)):
            if text in joints:
                order[str(text)] = position
        if numbers and first in joints:
            order[first] = int(numbers[-1])
    return order


def _names(table: pa.Table) -> list[str]:
    """Return the names of a table's columns; a column of lists is replaced by its elements, such as `q[0]`, `q[1]`.

    Names that occur more than once and columns without values are omitted.
    """
    names: list[str] = []
    for name, column in zip(table.column_names, table.columns, strict=True):
        if table.column_names.count(name) == 1 and column.null_count < len(column):
            names += [f"{name}[{index}]" for index in range(len(first_list(column)))] or [name]
    return names
