"""Draft of the mapping of a log's columns to quantities and joints, from the names and first values of the columns.

Units are derived from the column names, and the unit of times also from the time steps. Unknown units are assumed to be
SI units: the checks of logs then detect degrees, for example, and state the settings to write.
"""

import difflib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, groupby
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from spelgen.errors import LogError, shortened
from spelgen.labels import listed
from spelgen.logs.formats import BAG, FORMATS, LEROBOT, format_of
from spelgen.logs.parquet_files import dataset_motors
from spelgen.logs.tables import SERVO_ADVICE, names_joint, reading
from spelgen.logs.tuning import TUNING
from spelgen.logs.unit_checks import time_unit
from spelgen.settings.log_mapping import CURRENTS, LogMapping

WORDS = {
    quantity: frozenset(words.split())
    for quantity, words in (
        ("t", "t ts time times timestamp stamp clock datetime secs seconds millis zeit temps tiempo 时间"),
        ("q", "q qpos pos position positions angle angles theta θ winkel posicion posición 位置 角度"),
        ("qd", "qd dq qp qvel vel velocity velocities speed speeds omega ω geschwindigkeit vitesse velocidad 速度"),
        ("tau", "tau τ torque torques trq tq tor effort efforts eff force forces qfrc moment load current currents "
                "curr cur drehmoment strom couple par 力矩 扭矩"),
    )
}  # fmt: skip
# Words that distinguish the names of commanded values from the names of measured values.
COMMANDED = {
    "target", "desired", "des", "d", "command", "commanded", "cmd", "reference", "ref", "setpoint", "goal", "action",
    "demand", "planned", "ipo", "set", "soll", "u",
}  # fmt: skip
# Words in names of columns that mark signals other than measured joint signals.
NOT_MEASURED = COMMANDED | {
    "error", "std", "external", "ext", "tcp", "ee", "eef", "cartesian", "tool", "contact", "gravity", "friction",
    "dd", "ddot",
}  # fmt: skip
MEASURED = {"actual", "act", "measured", "meas", "present", "feedback", "fb", "ist"}
# For each quantity: units as written in column names, in lower case, and the corresponding units of a mapping.
UNITS = {
    "t": {"s": "s", "sec": "s", "ms": "ms", "millis": "ms", "us": "us", "ns": "ns"},
    "q": {"deg": "deg", "degs": "deg", "degree": "deg", "degrees": "deg", "°": "deg", "rad": "rad",
          "mrad": "mrad", "counts": "counts", "ticks": "counts", "turns": "turns", "rev": "turns", "mm": "mm",
          "m": "m"},
    "qd": {"deg/s": "deg/s", "degps": "deg/s", "dps": "deg/s", "rad/s": "rad/s", "mrad/s": "mrad/s", "°/s": "deg/s",
           "rev/s": "turns/s", "rpm": "rpm", "mm/s": "mm/s"},
    "tau": {"nm": "Nm", "mnm": "mNm", "n": "N", "a": "A", "amps": "A", "ampere": "A", "ma": "mA",
            "%": "percent", "percent": "percent", "‰": "permille", "permille": "permille"},
}  # fmt: skip
# Letters in column names that are units only in brackets: without brackets they may be part of a name.
BARE = {"s", "n", "a", "m"}
# Names of derivatives of positions, such as `d_theta` and `q_dot`.
DERIVATIVE = r"(?<![^\W\d_])(?:d[ _]?(?:theta|pos|q)|(?:theta|pos|q)[ _]?dot)(?![^\W\d_])"
JOINING = (
    "join files with a signal each by their times, in Python: pandas.read_csv(FILE).merge(pandas.read_csv(OTHER), "
    "on='t', suffixes=('_q', '_tau')).to_csv('log.csv', index=False)"
)
CURRENT = {"current", "currents", "curr", "cur", "strom"}


class Suggestion(NamedTuple):
    """Draft of a column mapping as YAML text with comments on its assumptions. missing: quantities without a column."""

    text: str
    missing: tuple[str, ...]


class ColumnName(NamedTuple):
    """Name of a column, the set of its words in lower case, and its unit ("" if the name contains none)."""

    name: str
    words: set[str]
    unit: str


def suggest_mapping(file: Path, joints: Sequence[str], *, commands: bool = False) -> Suggestion:
    """Return a draft of the column mapping for a log file, from the names and first values of its columns.

    commands: True if the log contains commanded positions instead of torques. Raises LogError for a file that cannot be
    read, is a ROS bag, has joint names in a column, or has only torques or only commands. If `commands` is False, the
    error is also raised for a file with only positions, or with commanded positions and no torques.
    """
    log_format = format_of(file)
    if log_format is LEROBOT:
        return _dataset_mapping(file, joints)
    assert log_format is not None, "log_files gives logs alone"
    if log_format is BAG:
        suffixes = " or ".join(x.suffixes[0] for x in FORMATS if not x.marker)
        do = "other names of joints are mapped by 'name' under 'logs', 'joints'"
        raise LogError("messages of ROS, with names and units", file=file, expected=suffixes, do=do)
    with reading(file):
        table = log_format.read(file, (), LogMapping())[0].read(None)
    texts = [field.name for field in table.schema if pa.types.is_string(field.type)]
    for name in (x for x in texts if set(joints) <= set(table[x].to_pylist())):
        do = f"in Python: wide = log.pivot(index=TIME, columns={name!r}); wide.columns = map('_'.join, wide.columns)"
        raise LogError(f"joints in the column {name!r}", file=file, expected="all joints in each row", do=do)
    return _table_mapping(table, file, joints, commands)


def _table_mapping(table: pa.Table, file: Path, joints: Sequence[str], commands: bool) -> Suggestion:
    """Return the draft of the column mapping for a table of the log `file`; for `commands` see `suggest_mapping`."""
    dates = {field.name for field in table.schema if pa.types.is_temporal(field.type)}
    columns = [_column_name(name, {"time"} if name in dates else set()) for name in _names(table)]
    columns_of = _by_quantity(columns, commands, joints)
    # A column named "load" is no torque: it is a register of a servo.
    torques = [x for x in columns_of.get("tau", ()) if "load" not in x.words]
    if not commands and not torques and len(_by_quantity(columns, True, joints)["u"]) >= len(joints):
        raise LogError("commanded positions and no torques", file=file, expected="torques", do=SERVO_ADVICE)
    clock = _clock(columns_of.pop("t"), columns)
    # Numbered columns are assigned to joints by cells that contain joint names, since the order in a log may differ
    # from the arm's: ROS often sorts joints by name.
    order = _order_in_cells(table, joints)
    by_joint = {x: _by_joint(_of_one_signal(named, joints), joints, order) for x, named in columns_of.items()}
    used = {clock.name, *(column.name for named in by_joint.values() for column in named.values())}
    absent = [word for x, word in (("q", "positions"), ("tau", "torques")) if by_joint.get(x) == {}]
    if absent and used.issuperset(x.name for x in columns):
        expected = "all signals of a recording in one file"
        raise LogError(
            f"no {listed(absent)} in addition to its other columns", file=file, expected=expected, do=JOINING
        )
    # A mapping has columns of velocities for all joints or for none. If the velocities of a joint are absent, all
    # velocities are computed from positions.
    if not commands and len(by_joint["qd"]) < len(joints):
        del by_joint["qd"]
    units = _units(clock, by_joint, table)
    rate = "sample_rate: # [Hz] of the rows, which have no times: write its value"
    lines = [
        f"# Drafted from the column names of {json.dumps(file.name)}: check it, and the order of the joints.",
        f"columns: {{t: {json.dumps(clock.name)}}}" if clock.name else rate,
        f"units: {json.dumps(units)}",
    ]
    if not commands and "qd" not in by_joint:
        lines.append("velocity: differentiated")
    lines += ["joints:", *chain.from_iterable(_joint_lines(joint, by_joint, units) for joint in joints)]
    # Comments of the draft list unused columns, for example of a gripper, or of another arm with similar names.
    unused = {x: _ranges([y.name for y in columns_of[x] if y.name not in used]) for x in by_joint}
    lines += [
        f"# not used for {x}: {shortened(names, TUNING.listed)}" for x, names in unused.items() if names
    ]
    missing = [f"{x} of {joint}" for joint in joints for x, named in by_joint.items() if joint not in named]
    return _suggestion(lines, missing, "column")


def _clock(clocks: Sequence[ColumnName], columns: Sequence[ColumnName]) -> ColumnName:
    """Return the best of the candidates ``clocks`` for the column of times; with the name "" if there is none.

    If it contains seconds, and ``columns`` (all columns) has its nanoseconds, the name is "SEC + NSEC" of both.
    """
    # The stamp in a message header is preferred to other columns of times, which may be times of receipt and not of
    # measurement. Without a stamp, the name with the fewest words is used.
    none = ColumnName("", set(), "s")
    clock = min(clocks, key=lambda x: ("header" not in x.words, len(x.words)), default=none)
    stamp = re.sub(r"secs?$", "", clock.name)
    nanoseconds = [x.name for x in columns if re.fullmatch(rf"{re.escape(stamp)}n(ano)?secs?", x.name)]
    if stamp != clock.name and nanoseconds:
        return ColumnName(f"{clock.name} + {nanoseconds[0]}", clock.words, "s")
    return clock


def _joint_lines(
    joint: str, by_joint: Mapping[str, Mapping[str, ColumnName]], units: Mapping[str, str]
) -> Iterator[str]:
    """Yield the lines of a joint: its columns, and the conversions whose values the user must write.

    by_joint: {quantity: {joint: column}}. units: {quantity: unit of its columns}.
    """
    entries = {quantity: named[joint].name for quantity, named in by_joint.items() if joint in named}
    yield from (f"  {json.dumps(joint)}:", f"    columns: {json.dumps(entries)}")
    if units.get("tau") in CURRENTS:
        yield f"    gain: 1.0 # Nm per {units['tau']} at the joint, the gear included: write its value"
    if units.get("q") == "counts":
        yield "    counts_per_turn: 4096 # of the joint, the gear included: write its value"


def _ranges(names: Sequence[str]) -> list[str]:
    """Return the names, with runs that differ only in a number, such as x1, x2, x3, abbreviated to `x1 ... x3`."""
    groups = [list(group) for _, group in groupby(names, lambda name: re.sub(r"\d+(?=\D*$)", "", name))]
    return [f"{x[0]} ... {x[-1]}" if len(x) > 2 else ", ".join(x) for x in groups]


def _suggestion(lines: Sequence[str], missing: Sequence[str], kind: str) -> Suggestion:
    notes = [f"# no {kind} was found for {column}" for column in missing]
    return Suggestion("\n".join([*lines, *notes, ""]), tuple(missing))


def _dataset_mapping(folder: Path, joints: Sequence[str]) -> Suggestion:
    """Return a draft of the mapping for a LeRobot data set, which assigns a motor to each joint by name."""
    motors = dataset_motors(folder)
    close = {x: [x] if x in motors else difflib.get_close_matches(x, motors, n=1) for x in joints}
    lines = [
        f"# Drafted from the motors of {json.dumps(folder.name)}: check it.",
        "# LeRobot stores degrees, 'units: {q: deg}', or -100..100 of the calibrated range:",
        "# 'units: {q: normalised}' and 'calibration:' with the content of the robot's calibration file.",
        "joints:",
        *(
            f"  {json.dumps(joint)}: {{name: {json.dumps(names[0])}}}"
            for joint, names in close.items()
            if names
        ),
    ]
    return _suggestion(lines, [f"q of {joint}" for joint, names in close.items() if not names], "motor")


def _column_name(name: str, words: set[str]) -> ColumnName:
    """Return the words and the unit in a column's name; the unit is in brackets, or the last word.

    words: additional words that describe the column, such as "time" for a column of dates.
    """
    bracketed = re.fullmatch(r"(.*?)\s*[\[(]([^\])\d',]+)[\])]", name)
    base, unit = bracketed.groups() if bracketed else (name, "")
    unit_names = set().union(*UNITS.values())
    last = re.fullmatch(r"(.*?)[\s_.]*?([^\W\d_]+(?:/s)?)", name)
    if not unit and last and last[2].lower() in unit_names - BARE and last[2] != name[:1]:
        base, unit = last.groups()
    separated = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", base)
    text = re.sub(DERIVATIVE, "qd", separated.lower())
    return ColumnName(name, words | set(re.findall(r"[^\W\d_]+", text)), unit.strip().lower())


def _by_quantity(
    columns: Sequence[ColumnName], commands: bool, joints: Sequence[str]
) -> dict[str, list[ColumnName]]:
    """Return {quantity: columns} for the quantities "t", "q", "qd", "tau" or "u".

    The quantity of a column is determined by the words in its name or, if these do not determine it, by its unit.

    commands: True for logs with commanded positions "u" instead of velocities and torques. joints: names of the joints.
    Columns with a word for commands, such as "d" or "target", are omitted from logs of torques. Words of joints' names
    do not count as words for commands.
    """
    by_quantity: dict[str, list[ColumnName]] = {x: [] for x in (("t", "q", "u") if commands else WORDS)}
    names = set().union(*(_column_name(joint, set()).words for joint in joints))
    for column in columns:
        quantity = next((x for x, words in WORDS.items() if column.words & words), None)
        if quantity is None:
            quantity = next((x for x, units in UNITS.items() if column.unit in units), None)
        if commands and column.words & (COMMANDED - names) and quantity in ("q", None):
            quantity = "u"
        elif column.words & (NOT_MEASURED - names):
            continue
        if quantity in by_quantity:
            by_quantity[quantity].append(column)
    return by_quantity


def _units(
    clock: ColumnName, by_joint: Mapping[str, Mapping[str, ColumnName]], table: pa.Table
) -> dict[str, str]:
    """Return {quantity: unit} from the units and words in column names; the unit of times also from the time steps.

    clock: column of the times. by_joint: {quantity: {joint: column}}. table: first rows of the log.
    """
    units = {"t": UNITS["t"].get(clock.unit) or _unit_of_times(clock.name, table) or "s"}
    for quantity, named in by_joint.items():
        for column in named.values():
            # A mapping has no separate unit of commands: the unit of positions applies to them.
            stated = UNITS.get(quantity, {}).get(column.unit)
            if stated is None and quantity == "qd":
                stated = {"deg": "deg/s", "rad": "rad/s"}.get(units.get("q", ""))
            if stated is None and quantity == "tau" and column.words & CURRENT:
                stated = "A"
            if stated is not None:
                units[quantity] = stated
    return units


def _unit_of_times(name: str, table: pa.Table) -> str | None:
    """Return the unit in which the median time step of a column is plausible for a log; None if there is none."""
    if name not in table.schema.names:
        return None
    times = table[name].drop_null()
    if not (pa.types.is_integer(times.type) or pa.types.is_floating(times.type)):
        return None
    steps = np.diff(times.to_numpy())
    return time_unit(float(np.median(steps[steps > 0]))) if len(steps) > 1 and (steps > 0).any() else None


def _order_in_cells(table: pa.Table, joints: Sequence[str]) -> dict[str, int]:
    """Return {joint: number of its columns}, such as 2 for the column `q[2]`, from joint names in the first row.

    The names are cells of columns `name0`, `name1`, ..., or elements of a list: "elbow" in the column `name2` gives
    {"elbow": 2}. Joints whose names are not in the row are omitted.
    """
    order: dict[str, int] = {}
    for name, column in zip(table.schema.names, table.columns if len(table) else (), strict=False):
        numbers, first = re.findall(r"\d+", name), column[0].as_py()
        for position, text in enumerate(_first_list(column)):
            if text in joints:
                order[str(text)] = position
        if numbers and first in joints:
            order[first] = int(numbers[-1])
    return order


def _names(table: pa.Table) -> list[str]:
    """Return the names of a table's columns; a column of lists is replaced by its elements, such as `q[0]`, `q[1]`.

    Names that two columns have are omitted.
    """
    names: list[str] = []
    for name, column in zip(table.column_names, table.columns, strict=True):
        if table.column_names.count(name) == 1:
            names += [f"{name}[{index}]" for index in range(len(_first_list(column)))] or [name]
    return names


def _first_list(column: pa.ChunkedArray) -> list[object]:
    """Return the first list of a column of lists, which may be texts such as "[0.1, 0.2]"; [] for other columns."""
    first = next(iter(column.drop_null().slice(0, 1).to_pylist()), None)
    if isinstance(first, str) and (match := re.fullmatch(r"[\w.]*[\[(]+(.*?)[\])]+", first.strip())):
        first = [text.strip("'\"") for text in re.split(r"[,;\s]+", match[1].strip())]
    return first if isinstance(first, list) else []


def _of_one_signal(columns: Sequence[ColumnName], joints: Sequence[str]) -> Sequence[ColumnName]:
    """Return the columns of the best signal of a quantity, for example of the measured and not the desired positions.

    A log may contain several signals of a quantity, each with a column for each joint. Names of a signal's columns
    differ only in the words of the joint. Torques are preferred to currents, torques of joints to torques of motors,
    names with a word such as "actual" to others, and names with few words to longer ones: `tau_J` to
    `tau_hat_filtered`.

    columns: all columns of the quantity, which are returned if no signal has a column for each joint.
    """
    signals: dict[frozenset[str], list[ColumnName]] = {}
    for column in columns:
        joint = max((x for x in joints if names_joint(column.name, x)), key=len, default="")
        signals.setdefault(frozenset(column.words - _column_name(joint, set()).words), []).append(column)
    complete = [
        ((bool(words & CURRENT), "motor" in words, not words & MEASURED, len(words)), named)
        for words, named in signals.items()
        if len(named) >= len(joints)
    ]
    return min(reversed(complete), key=itemgetter(0), default=((), columns))[1]


def _by_joint(
    columns: Sequence[ColumnName], joints: Sequence[str], order: Mapping[str, int]
) -> dict[str, ColumnName]:
    """Return {joint: column}: the column whose name contains the name of the joint.

    If no column name contains a joint name, columns are assigned by the last number in their names: to the joint with
    this number in `order` or, if `order` does not contain all joints, in ascending order to `joints`. order: {joint:
    number}, the result of `_order_in_cells`.
    """
    named = {joint: column for joint in joints for column in columns if names_joint(column.name, joint)}
    numbers = [(re.findall(r"\d+", column.name), column) for column in columns]
    numbered = {int(match[-1]): column for match, column in numbers if match}
    if named or len(numbered) < len(joints):
        return named
    if set(order) == set(joints):
        return {joint: numbered[order[joint]] for joint in joints if order[joint] in numbered}
    return dict(zip(joints, map(numbered.__getitem__, sorted(numbered)), strict=False))
