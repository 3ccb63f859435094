"""Draft of the mapping of a log's columns to quantities and joints, from the names and first values of the columns.

Units are derived from the column names, and the unit of times also from the time steps. Unknown units are assumed to be
SI units: the checks of logs then detect degrees, for example, and state the settings to write.
"""

import json
import re
import unicodedata
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, groupby, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from spelgen.errors import LogError, shortened
from spelgen.labels import listed
from spelgen.logs.formats import BAG, FORMATS, LEROBOT, format_of
from spelgen.logs.parquet_files import dataset_motors
from spelgen.logs.tables import JOINTS_KEY, SERVO_ADVICE, joint_patterns, reading, stated_units, stored_names
from spelgen.logs.tuning import TUNING
from spelgen.logs.unit_checks import time_unit
from spelgen.logs.values import logged_column
from spelgen.settings.log_mapping import CURRENTS, UNIT_NAMES, LogMapping, is_unit, mapped_unit, plain_unit

WORDS = {
    quantity: frozenset(words.split())
    for quantity, words in (
        ("t", "t ts tm time times timestamp stamp clock tick datetime secs seconds millis zeit zeitstempel uhrzeit "
              "temps tiempo tempo tijd czas время 时间 時間 時刻 시간"),
        ("q", "q qpos pos position positions angle angles theta θ winkel posicion posición posizione posição positie "
              "hoek положение позиция угол 位置 角度 위치 각도"),
        ("qd", "qd dq qp qvel vel velocity velocities speed speeds omega ω geschwindigkeit geschw vitesse velocidad "
               "velocidade velocità snelheid prędkość скорость spd 速度 속도"),
        ("tau", "tau τ torque torques trq tq tor effort efforts eff force forces qfrc moment load current currents "
                "curr cur iq iqf drehmoment strom couple par coppia corrente corriente koppel момент ток 力矩 扭矩 "
                "电流 トルク 電流 토크 전류"),
    )
}  # fmt: skip
# Words in names of columns that mark commanded values, measured values, signals other than those of joints, and values
# that a model computed, which are used only if the log has no others.
COMMANDED, MEASURED, OTHERS, COMPUTED = (
    frozenset(words.split())
    for words in (
        "target targets desired des d command commands commanded cmd reference ref setpoint goal action demand planned "
        "ipo set soll u leader consigne заданное заданный 目标 指令 设定 目標 목표",
        "actual act ai measured meas msr present feedback feed fb ist follower observation mesure 实际 反馈 実 現在 "
        "현재 실제",
        "error err std external ext tcp ee eef cartesian tool contact gravity friction disturbance dist interact dd "
        "ddot dot vol volt voltage temp temperature bias passive constraint residual payload 温度",
        "computed model predicted pred sim simulated g c f",
    )
)
# Letters that are quantities in names such as `i_actual` and `m_actual`.
LETTERS = {"i": "tau", "m": "tau"}
# Letters in column names that are units only in brackets: without brackets they may be part of a name.
BARE = {"s", "n", "a", "m"}
# Names of derivatives of positions, such as `d_theta` and `q_dot`.
DERIVATIVE = r"(?<![^\W\d_])(?:d[ _]?(?:theta|pos|q)|(?:theta|pos|q)[ _]?dot)(?![^\W\d_])"
JOINING = (
    "join files with a signal each by their times, in Python: pandas.read_csv(FILE).merge(pandas.read_csv(OTHER), "
    "on='t', suffixes=('_q', '_tau')).to_csv('log.csv', index=False)"
)
# All words that state something about a signal; others may be the name of an arm.
KNOWN = COMMANDED.union(MEASURED, OTHERS, COMPUTED, *WORDS.values())
FILTERED = {"filt", "filtered", "smooth", "smoothed"}
CURRENT = {"current", "currents", "curr", "cur", "iq", "iqf", "strom", "corrente", "corriente", "ток", "i"}
CURRENT |= {"电流", "電流", "전류"}
# Words that are not separated from others by blanks: words of Chinese, Japanese and Korean anywhere, long words at the
# end of a compound such as `Gelenkwinkel` or `motortorque`, and short words after the J of a joint, as in `JPOS1`.
GLUED = re.compile(
    "|".join(x for x in sorted(KNOWN.union(OTHERS), key=len, reverse=True) if x > "⺀")
    + rf"|(?<=[^\W\d_])(?:{'|'.join(x for x in WORDS['q'].union(WORDS['qd'], WORDS['tau']) if len(x) > 4)})(?![^\W\d_])"
    + r"|(?<=\bj)(?:pos|vel|trq|tau|cmd|cur)(?![^\W\d_])"
)


class Suggestion(NamedTuple):
    """Draft of a column mapping as YAML text with comments on its assumptions. missing: quantities without a column."""

    text: str
    missing: tuple[str, ...]


class ColumnName(NamedTuple):
    """Name of a column, and its parts.

    Attributes:
        name: the name.
        words: words of the name in lower case, without the words of the joint.
        unit: unit in the name, or in a line of units below the header; "" if there is none.
        joint: joint whose name the column's name contains; "" if there is none.
        quantity: "t", "q", "qd" or "tau"; None if neither words nor unit state it.
        number: last number in the name without its unit; -1 if there is none.
    """

    name: str
    words: set[str]
    unit: str = ""
    joint: str = ""
    quantity: str | None = None
    number: int = -1


ByJoint = Mapping[str, Mapping[str, ColumnName]]


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
    return _table_mapping(table, file, joints, commands)


def _names_signals(values: Sequence[object], joints: int) -> bool:
    """Return True if the values of a column name the signal or the joint of each row, and rows have one signal each.

    Such a value differs from the value of the row before, and each value occurs equally often.
    """
    counts = Counter(values).values()
    is_cycle = 1 < joints <= len(counts) <= len(values) / 2 and max(counts) - min(counts) <= 1
    return is_cycle and all(x != y for x, y in pairwise(values))


def _table_mapping(table: pa.Table, file: Path, joints: Sequence[str], commands: bool) -> Suggestion:
    """Return the draft of the column mapping for a table of the log `file`; for `commands` see `suggest_mapping`."""
    dates = {field.name for field in table.schema if pa.types.is_temporal(field.type)}
    names, stated = _names(table), stated_units(table.schema)
    labels = joint_patterns(joints, names)
    columns = [_column_name(x, labels, stated.get(x, ""), {"time"} if x in dates else set()) for x in names]
    if not commands:
        columns = _with_letters(_with_states(columns, table, len(joints)), table)
    columns_of = _by_quantity(columns, commands, len(joints))
    # A column named "load" is no torque: it is a register of a servo.
    torques = [x for x in columns_of.get("tau", ()) if "load" not in x.words]
    if not commands and not torques and len(_by_quantity(columns, True, len(joints))["u"]) >= len(joints):
        raise LogError("commanded positions and no torques", file=file, expected="torques", do=SERVO_ADVICE)
    # An arm at rest, whose columns are constant, is no candidate.
    moving = [x for x in columns_of["q"] if len(set(_numbers(table, x.name).tolist())) > 1]
    _require_one_arm(moving, len(joints), file)
    clocks = columns_of.pop("t")
    clock = _clock(clocks, columns, table)
    # Of more numbered columns than joints, the moving ones belong to the arm: others are of a base or gripper at rest.
    moved = {x.number for x in _of_one_signal(moving, len(joints))}
    if len(moved) == len(joints):
        for quantity, named in columns_of.items():
            complete = [x for x in named if x.number in moved]
            columns_of[quantity] = complete if {x.number for x in complete} == moved else named
    # Numbered columns are assigned to joints by cells that contain joint names, since the order in a log may differ
    # from the arm's: ROS often sorts joints by name.
    order = _order_in_cells(table, joints)
    signals = {x: _of_one_signal(named, len(joints)) for x, named in columns_of.items()}
    by_joint = {x: _by_joint(named, joints, order) for x, named in signals.items()}
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
        raise LogError(got, file=file, expected=expected, do=JOINING)
    # A mapping has columns of velocities for all joints or for none. If the velocities of a joint are absent, all
    # velocities are computed from positions.
    if not commands and len(by_joint["qd"]) < len(joints):
        del by_joint["qd"]
    units = _units(by_joint, joints)
    common = _common(units)
    common = {"t": mapped_unit("t", clock.unit) or _unit_of_times(clock.name, table) or "s"} | common
    rate = "sample_rate: # [Hz] of the rows, which have no times: write its value"
    lines = [
        f"# Drafted from the column names of {json.dumps(file.name)}: check it, and the order of the joints.",
        f"columns: {{t: {json.dumps(clock.name)}}}" if clock.name else rate,
        f"units: {json.dumps(common)}",
    ]
    if not commands and "qd" not in by_joint:
        lines.append("velocity: differentiated")
    if any(x.words & COMMANDED for x in by_joint.get("tau", {}).values()):
        lines.append("# tau: commanded torques, since no others were logged")
    lines += ["joints:", *chain.from_iterable(_joint_lines(x, by_joint, units[x], common) for x in joints)]
    # Comments of the draft list unused columns, for example of a gripper, or of another arm with similar names.
    used |= set(clock.name.split(" + "))
    columns_of = {"t": clocks} | {x: columns_of[x] for x in by_joint}
    unused = {x: _ranges([y.name for y in named if y.name not in used]) for x, named in columns_of.items()}
    lines += [f"# not used for {x}: {shortened(y, TUNING.listed)}" for x, y in unused.items() if y]
    unknown = {
        (quantity, column.unit)
        for quantity, named in [*by_joint.items(), ("t", {"": clock})]
        for column in named.values()
        if column.unit and not mapped_unit(quantity, column.unit)
    }
    lines += [f"# not a known unit of {quantity}: {unit}" for quantity, unit in sorted(unknown)]
    missing = [f"{x} of {joint}" for joint in joints for x, named in by_joint.items() if joint not in named]
    lines += [f"# no column was found for {name}" for name in missing]
    return Suggestion("\n".join([*lines, ""]), tuple(missing))


def _with_states(columns: Sequence[ColumnName], table: pa.Table, joints: int) -> list[ColumnName]:
    """Return the columns with quantities of a state [q; qd], such as x0, x1, ..., of which the names state nothing.

    The last half of the state's columns are the derivatives of the first half. joints: number of joints.
    """
    unstated = [x for x in columns if x.number >= 0 and not x.words & (COMMANDED | OTHERS)]
    unstated = [x for x in unstated if x.quantity in ("q", None)]
    quantity = {}
    for state in _complete_signals(unstated, 2 * joints).values():
        ordered = sorted(state, key=lambda x: x.number)
        pairs = list(zip(ordered[:joints], ordered[joints:], strict=False))
        if len(state) == 2 * joints and _similarity(pairs, table)[0] > 0.9:
            for q, qd in pairs:
                quantity[q.name] = q._replace(quantity="q", words={"q"})
                quantity[qd.name] = qd._replace(quantity="qd", words={"qd"}, number=q.number)
    return [quantity.get(x.name, x) for x in columns]


def _similarity(pairs: Sequence[tuple[ColumnName, ColumnName]], table: pa.Table) -> tuple[float, float]:
    """Return the correlation of columns x with the derivatives of columns q, and the relative distance of x and q.

    Both are medians over the pairs (q, x) that move; NaN if none does.
    """
    values = [(_numbers(table, q.name), _numbers(table, x.name)) for q, x in pairs]
    moving = [(q, x) for q, x in values if len(q) == len(x) > 2 and np.ptp(q) * np.ptp(x) > 0]
    slopes = [np.corrcoef(np.gradient(q), x)[0, 1] for q, x in moving] or [np.nan]
    return float(np.median(slopes)), float(
        np.median([np.std(x - q) / np.std(q) for q, x in moving] or [np.nan])
    )


def _with_letters(columns: Sequence[ColumnName], table: pa.Table) -> list[ColumnName]:
    """Return the columns with quantities of names such as `t0`, `v0` and `u0`, which letters do not determine.

    Numbered columns `t` are torques. `v` and `u` are velocities if they are correlated with the derivatives of the
    positions; otherwise `u` are commanded positions if they are close to the positions, or torques.
    """
    result = list(columns)
    of_number = {
        x.number: x for x in columns if x.quantity == "q" and x.number >= 0 and not x.words & COMMANDED
    }
    for letter in "tvu":
        named = [k for k, x in enumerate(result) if x.words == {letter} and x.number in of_number]
        slope, distance = _similarity([(of_number[result[k].number], result[k]) for k in named], table)
        if np.isnan(slope):
            continue
        quantity = "tau" if letter == "t" or (letter == "u" and distance > 0.3) else None
        if letter != "t" and slope > 0.9:
            quantity = "qd"
        # Temperatures `t0`, for example, are no torques if the log has torques.
        present = {x.quantity for x in result if not x.words & (COMMANDED | OTHERS)}
        for k in named if quantity and quantity not in present else ():
            result[k] = result[k]._replace(quantity=quantity, words={str(quantity)})
    return result


def _require_joints_in_columns(table: pa.Table, names: Sequence[str], joints: int, file: Path) -> None:
    """Raise LogError if one of the columns `names` names the joint or the signal of each row of the log `file`.

    joints: number of joints.
    """
    for name in names:
        if name in table.column_names and _names_signals(table[name].to_pylist(), joints):
            do = (
                f"in Python: wide = log.pivot(index=TIME, columns={name!r}); "
                "wide.columns = [f'{x}_{y}' for x, y in wide.columns]"
            )
            got = f"joints in the column {name!r}"
            raise LogError(got, file=file, expected="all joints in each row", do=do)


def _clock(clocks: Sequence[ColumnName], columns: Sequence[ColumnName], table: pa.Table) -> ColumnName:
    """Return the best of the candidates ``clocks`` for the column of times; with the name "" if there is none.

    Without candidates, it is a column whose values rise like a clock. If it contains whole seconds, and ``columns``
    (all columns) has its nanoseconds, the name is "SEC + NSEC" of both.
    """
    # The stamp in a message header is preferred to other columns of times, which may be times of receipt and not of
    # measurement. Without a stamp, the name with the fewest words is used, or of several the most regular times.
    nanoseconds = [x for x in columns if re.search(r"n(?:anos|(?:ano)?sec(?:ond)?s?)$", x.name.lower())]
    seconds = [x for x in clocks if x not in nanoseconds]
    if not seconds:
        seconds = [x for x in columns if not (x.quantity or x.joint) and _is_rising(_numbers(table, x.name))]
    absent = ColumnName("", set(), "s")
    clock = min(
        seconds, key=lambda x: ("header" not in x.words, len(x.words), _jitter(table, x)), default=absent
    )
    times = _numbers(table, clock.name)
    # Seconds of a stamp are whole numbers that repeat.
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
    """Return the numbers of a column, or of an element of lists, without nulls; an empty array for other values."""
    is_stored = name and stored_names(name, table.column_names)
    values = logged_column(table, name).drop_null() if is_stored else pa.chunked_array([[]])
    is_numeric = pa.types.is_integer(values.type) or pa.types.is_floating(values.type)
    return np.asarray(values.to_numpy()) if is_numeric else np.zeros(0)


def _joint_lines(
    joint: str, by_joint: ByJoint, units: Mapping[str, str], common: Mapping[str, str]
) -> Iterator[str]:
    """Yield the lines of a joint: its columns, and the conversions whose values the user must write.

    by_joint: {quantity: {joint: column}}. units: {quantity: unit} of the joint; common: the same of all joints.
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


def _ranges(names: Sequence[str]) -> list[str]:
    """Return the names, with runs that differ only in a number, such as x1, x2, x3, abbreviated to `x1 ... x3`."""
    groups = [list(group) for _, group in groupby(names, lambda name: re.sub(r"\d+(?=\D*$)", "", name))]
    return [f"{x[0]} ... {x[-1]}" if len(x) > 2 else ", ".join(x) for x in groups]


def _dataset_mapping(folder: Path, joints: Sequence[str]) -> Suggestion:
    """Return a draft of the mapping for a LeRobot data set, which assigns a motor to each joint by name."""
    motors = dataset_motors(folder)
    motor_of = {x: next(filter(y.search, motors), None) for x, y in joint_patterns(joints, motors).items()}
    lines = [
        f"# Drafted from the motors of {json.dumps(folder.name)}: check it.",
        "# LeRobot stores degrees, 'units: {q: deg}', or -100..100 of the calibrated range:",
        "# 'units: {q: normalised}' and 'calibration:' with the content of the robot's calibration file.",
        "joints:",
        *(f"  {json.dumps(joint)}: {{name: {json.dumps(name)}}}" for joint, name in motor_of.items() if name),
    ]
    missing = [f"q of {joint}" for joint, name in motor_of.items() if not name]
    lines += [f"# no motor was found for {name}" for name in missing]
    return Suggestion("\n".join([*lines, ""]), tuple(missing))


def _column_name(name: str, labels: Mapping[str, re.Pattern[str]], unit: str, words: set[str]) -> ColumnName:
    """Return the parts of a column's name; the unit is in brackets, or the last word.

    labels: {joint: pattern of its name}. unit: unit in a line of units below the header. words: additional words that
    describe the column, such as "time" for a column of dates.
    """
    # Units in brackets are removed before the search of joints: "deg/s" is not the joint s. Other brackets may contain
    # a number or a joint.
    fraction = (
        r"[\W_](\d*\.\d+ ?[^\W\d_]+|(?:\d*\.\d+ ?)?[%‰])(?![^\W_])"  # a unit such as 0.1%, at any place
    )
    for bracket in re.finditer(rf"\s*[\[(]([^\])]+)[\])]|{fraction}", name):
        text = bracket[1] or bracket[2]
        is_other = re.search(r"[\d',]", text) or text in labels
        if is_unit(plain_unit(text)) or (bracket.end() == len(name) and not is_other):
            unit, name_without = plain_unit(text), name.replace(bracket[0], "", 1)
            return _column_name(name_without, labels, unit, words)._replace(name=name)
    matches = {joint: match for joint, label in labels.items() if (match := label.search(name))}
    joint = max(matches, key=lambda x: len(matches[x][0]), default="")
    bare = labels[joint].sub(" ", name) if joint else name
    numbers = re.findall(r"\d+", bare)
    # A column with the name of a joint has its positions, except for `t` of a joint that is called t.
    if joint and name.lower() in WORDS["t"]:
        joint, bare = "", name
    last = re.fullmatch(r"(.*?)[\s_.]*?((?:[^\W\d_]|°)+(?:/s|[\s_](?:per[\s_])?s)?)(?:(?!°)[\W\d_])*", bare)
    is_bare = last and (last[2].lower() in BARE or last[2] == name[:1])
    if not unit and last and not is_bare and is_unit(plain_unit(last[2])):
        bare, unit = last[1], plain_unit(last[2])
    separated = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", bare).lower()
    separated = GLUED.sub(r" \g<0> ", unicodedata.normalize("NFKC", separated))
    texts = re.findall(r"[^\W\d_]+", re.sub(DERIVATIVE, "qd", separated))
    words = words | set(texts) | ({"theta"} if "theta" in separated else set())
    quantity = "t" if words & WORDS["t"] else None
    # The last word that states a quantity is the noun: `position` in `current_position` or `velocity_control/position`.
    for word in reversed(texts):
        if quantity is None and (quantity := next((x for x, y in WORDS.items() if word in y), None)):
            # The values of `current_torque` and `current_as_torque` are no currents.
            words = words if word in CURRENT else words - CURRENT
    quantity = quantity or next((x for x in UNIT_NAMES if mapped_unit(x, unit)), None)
    if quantity is None and words & MEASURED:
        quantity = next((LETTERS[x] for x in texts if x in LETTERS), None)
    return ColumnName(name, words, unit, joint, quantity, int(numbers[-1]) if numbers else -1)


def _by_quantity(columns: Sequence[ColumnName], commands: bool, joints: int) -> dict[str, list[ColumnName]]:
    """Return {quantity: columns} for the quantities "t", "q", "qd", "tau" or "u".

    commands: True for logs with commanded positions "u" instead of velocities and torques. joints: number of joints.
    Columns with a word for commands, such as "d" or "target", are omitted from logs of torques. If no names state
    positions, columns that only name a joint are positions.
    """
    by_quantity: dict[str, list[ColumnName]] = {x: [] for x in (("t", "q", "u") if commands else WORDS)}
    unstated, commanded = [], []
    for column in columns:
        quantity = column.quantity
        if commands and column.words & COMMANDED and quantity in ("q", None):
            quantity = "u"
        elif column.words & (COMMANDED | OTHERS):
            if column.quantity == "tau" and not column.words & (OTHERS | CURRENT):
                commanded.append(column)
            continue
        if quantity is None and (column.joint or column.words & {"joint", "joints", "axis", "axes"}):
            unstated.append(column)
        if quantity in by_quantity:
            by_quantity[quantity].append(column)
    if len(by_quantity["q"]) < joints:
        by_quantity["q"] += unstated
    # If no other torques were logged, the commanded torques are used.
    if not commands and not by_quantity["tau"]:
        by_quantity["tau"] = commanded
    return by_quantity


def _units(by_joint: ByJoint, joints: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return {joint: {quantity: unit}} from the units and words of columns. by_joint: {quantity: {joint: column}}."""
    units: dict[str, dict[str, str]] = {joint: {} for joint in joints}
    for quantity, named in by_joint.items():
        for joint, column in named.items():
            unit = mapped_unit(quantity, column.unit)
            if unit is None and quantity == "qd" and "q" in units[joint]:
                unit = f"{units[joint]['q']}/s"
            if unit is None and quantity == "tau" and column.words & CURRENT:
                unit = "A"
            # The unit of positions also applies to commands.
            if unit is not None and (quantity != "u" or unit != units[joint].get("q")):
                units[joint][quantity] = unit
    return units


def _common(units: Mapping[str, Mapping[str, str]]) -> dict[str, str]:
    """Return {quantity: unit} of the units that all joints have. units: {joint: {quantity: unit}}."""
    first = next(iter(units.values()), {})
    return {x: unit for x, unit in first.items() if all(y.get(x) == unit for y in units.values())}


def _unit_of_times(name: str, table: pa.Table) -> str | None:
    """Return the unit in which the median time step of a column is plausible for a log; None if there is none."""
    times = _numbers(table, name)
    steps = np.diff(times)
    # Ticks of 100 ns since 1601 (Windows) or the year 1 (.NET), in years from 2000 to 2080.
    if times.size and any(low < times[0] / 3.2e14 < low + 80 for low in (394, 1972)):
        return "0.1 us"
    return time_unit(float(np.median(steps[steps > 0]))) if (steps > 0).any() else None


def _order_in_cells(table: pa.Table, joints: Sequence[str]) -> dict[str, int]:
    """Return {joint: number of its columns}, such as 2 for the column `q[2]`, from joint names in the first row.

    The names are cells of columns `name0`, `name1`, ..., or elements of a list: "elbow" in the column `name2` gives
    {"elbow": 2}. Joints whose names are not in the row are omitted.
    """
    listed_names = json.loads((table.schema.metadata or {}).get(JOINTS_KEY, "[]"))
    order = {name: position for position, name in enumerate(listed_names) if name in joints}
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

    Names that two columns have are omitted, and columns without values.
    """
    names: list[str] = []
    for name, column in zip(table.column_names, table.columns, strict=True):
        if table.column_names.count(name) == 1 and column.null_count < len(column):
            names += [f"{name}[{index}]" for index in range(len(_first_list(column)))] or [name]
    return names


def _first_list(column: pa.ChunkedArray) -> list[object]:
    """Return the first list of a column of lists, which may be texts such as "[0.1, 0.2]"; [] for other columns."""
    first = next(iter(column.drop_null().slice(0, 1).to_pylist()), None)
    if isinstance(first, str) and (match := re.fullmatch(r"[^\[({]*[\[({]+(.*?)[\])}]+", first.strip())):
        first = [text.strip("'\"") for text in re.split(r"[,;\s]+", match[1].strip())]
    return first if isinstance(first, list) else []


def _of_one_signal(columns: Sequence[ColumnName], joints: int) -> Sequence[ColumnName]:
    """Return the columns of the best signal of a quantity, for example of the measured and not the desired positions.

    A log may contain several signals of a quantity, each with a column for each joint. Names of a signal's columns
    differ only in the words of the joint. Measurements are preferred to values that a model computed, torques to
    currents, signals of joints to signals of motors, names with a word such as "actual" to others, values without a
    filter to filtered ones, and names with few words to longer ones: `tau_J` to
    `tau_hat_filtered`.

    columns: all columns of the quantity, which are returned if no signal has a column for each of the `joints`.
    """
    complete = _complete_signals(columns, joints)
    best = min(reversed(complete), key=_rank, default=frozenset[str]())
    return complete.get(best, columns)


def _complete_signals(columns: Sequence[ColumnName], joints: int) -> dict[frozenset[str], list[ColumnName]]:
    """Return {words of the names: columns} of the signals that have a column for each of the `joints`."""
    signals: dict[frozenset[str], list[ColumnName]] = {}
    for column in columns:
        signals.setdefault(frozenset(column.words), []).append(column)
    return {words: named for words, named in signals.items() if len(named) >= joints}


def _require_one_arm(columns: Sequence[ColumnName], joints: int, file: Path) -> None:
    """Raise LogError for positions of several arms, such as `left_q1` and `right_q1`, or q0 to q13 of 7 joints.

    columns: columns of changing positions in the log `file`. joints: number of joints.
    """
    signals = _complete_signals(columns, joints)
    best = min(signals, key=_rank, default=frozenset[str]())
    # The name of an arm states nothing about the signal. It may also be a number, which is not among the words.
    arms = [x for x in signals if _rank(x) == _rank(best) and not (x ^ best) & KNOWN]
    of_joint: dict[str, list[str]] = {}
    for column in chain.from_iterable(signals[x] for x in arms):
        label = column.joint or (str(column.number) if column.number >= 0 else column.name)
        of_joint.setdefault(label, []).append(column.name)
    rivals = max(of_joint.values(), key=len, default=[])
    if len(rivals) > 1 and len(of_joint) >= joints:
        raise LogError(
            f"positions of {len(rivals)} arms: {shortened(rivals, TUNING.listed)} are of one joint", file=file,
            expected="columns of one arm", do="remove the columns of the other arms, or write the mapping by hand",
        )  # fmt: skip
    unnamed = [x.name for x in signals.get(best, ()) if not x.joint]
    if len(unnamed) >= 2 * joints:
        got = f"{len(unnamed)} columns of positions that change: {shortened(_ranges(unnamed), TUNING.listed)}"
        raise LogError(
            got, file=file, expected=f"{joints}, one for each joint",
            do="remove the columns of other joints, or write the mapping by hand",
        )  # fmt: skip


def _rank(words: frozenset[str]) -> list[int]:
    """Return the order of preference of a signal with these words, the smallest first (see `_of_one_signal`)."""
    ranks = [not words.isdisjoint(x) for x in (COMPUTED, CURRENT, {"motor", "theta"})]
    return [*ranks, words.isdisjoint(MEASURED), not words.isdisjoint(FILTERED), len(words)]


def _by_joint(
    columns: Sequence[ColumnName], joints: Sequence[str], order: Mapping[str, int]
) -> dict[str, ColumnName]:
    """Return {joint: column}: the column whose name contains the name of the joint.

    If no column name contains a joint name, columns are assigned by the last number in their names: to the joint with
    this number in `order` or, if `order` does not contain all joints, in ascending order to `joints`. order: {joint:
    number}, the result of `_order_in_cells`.
    """
    named = {column.joint: column for column in columns if column.joint}
    numbered = {x.number: x for x in columns if x.number >= 0}
    # pandas numbers equal names from the second one: q, q.1, q.2.
    if len(numbered) == len(joints) - 1:
        numbered = {x.number: x for x in columns}
    if named or len(numbered) < len(joints):
        return {joint: named[joint] for joint in joints if joint in named}
    if set(order) == set(joints):
        return {joint: numbered[order[joint]] for joint in joints if order[joint] in numbered}
    return dict(zip(joints, map(numbered.__getitem__, sorted(numbered)), strict=False))
