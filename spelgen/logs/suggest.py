"""Draft the mapping of a log that nobody has described, as far as its names and numbers tell."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute

from spelgen.errors import LogError
from spelgen.logs.checks import TURNS
from spelgen.logs.formats import FORMATS, format_of
from spelgen.logs.tables import names_joint
from spelgen.logs.trajectory import QUANTITIES
from spelgen.logs.values import column_values
from spelgen.settings.log_mapping import TIMES

WORDS = {
    "t": {"t", "time", "times", "timestamp", "stamp", "clock", "ms", "us", "ns", "sec", "secs", "seconds", "millis"},
    "q": {"q", "pos", "position", "positions", "angle", "angles", "theta"},
    "qd": {"qd", "dq", "vel", "velocity", "velocities", "speed", "speeds", "omega"},
    "tau": {"tau", "torque", "torques", "effort", "efforts", "current", "currents", "amps", "curr", "moment"},
}  # fmt: skip
NOT_MEASURED = {"target", "desired", "command", "cmd", "reference", "ref", "setpoint", "goal", "error", "std"}
JOINT_NAMES = ("name", "names", "joint_names", "joints")
UNITS = {
    "t": {"ms": "ms", "millis": "ms", "us": "us", "ns": "ns"},
    "q": {"deg": "deg", "degree": "deg", "degrees": "deg", "mm": "mm"},
    "qd": {"deg": "deg/s", "degrees": "deg/s", "dps": "deg/s", "rpm": "rpm", "mm": "mm/s"},
    "tau": {
        "mnm": "mNm",
        "ma": "mA",
        **dict.fromkeys(("amps", "ampere", "current", "currents", "curr"), "A"),
    },
}


class Column(NamedTuple):
    """Describe a column, or one element of a column of lists. number: its place, or the last number in its name."""

    name: str
    quantity: str
    words: tuple[str, ...]
    number: int | None


@dataclass(frozen=True)
class Suggestion:
    """Hold a mapping as YAML text, with comments on what was assumed. missing: what no column was found for."""

    text: str
    missing: tuple[str, ...]


def suggest_mapping(file: Path, joints: Sequence[str], joint_types: Sequence[str]) -> Suggestion:
    """Return how a file may be read. Raises LogError where it cannot be opened, or has no column of times."""
    table = _table(file)
    columns = _measured_columns(table)
    times = [column for column in columns if column.quantity == "t"]
    if not times:
        names = ", ".join(table.column_names)
        raise LogError(f"only the columns {names}", file=file, expected="one of times, called t or time")
    # `time` before `timestamp_of_receipt`: what has the fewest words is the plain clock
    clock = min(times, key=lambda column: len(column.words))
    order = _joint_order(table, file)
    by_joint = {quantity: _by_joint(columns, quantity, joints, order) for quantity in QUANTITIES}
    turning = [joint for joint, kind in zip(joints, joint_types, strict=True) if kind == "revolute"]
    units = {"t": _time_unit(clock, table)}
    angles = _angle_units(by_joint, turning, table, file, clock.name, TIMES[units["t"]])
    if len(turning) == len(joints):
        units |= angles
    torque = _unit_in_names("tau", by_joint["tau"].values())
    if torque is not None:
        units["tau"] = torque
    differentiated = len(by_joint["qd"]) < len(joints)
    lines = [f"# Read off the names and numbers of {json.dumps(file.name)}: check it before you rely on it."]
    named = [joint for joint, column in by_joint["q"].items() if names_joint(column.name, joint)]
    if not order and not named:
        lines.append("# Joints are taken in the URDF's order: the log does not name them.")
    lines += [f"columns: {{t: {json.dumps(clock.name)}}}", f"units: {json.dumps(units)}"]
    if differentiated:
        lines.append("velocity: differentiated")
        del by_joint["qd"]
    lines.append("joints:")
    for joint in joints:
        entries: dict[str, str] = {}
        for quantity, named_columns in by_joint.items():
            if joint in named_columns:
                entries[quantity] = named_columns[joint].name
        lines += [f"  {json.dumps(joint)}:", f"    columns: {json.dumps(entries)}"]
        if angles and joint in turning and len(turning) < len(joints):
            lines.append(f"    units: {json.dumps(angles)}")
        if torque in ("A", "mA"):
            lines.append(f"    gain: 1.0 # Nm per {torque} at the joint, the gear included: write its value")
    missing = []
    for quantity in ("q", "tau"):
        missing += [f"{quantity} of {joint}" for joint in joints if joint not in by_joint[quantity]]
    lines += [f"# no column was found for {column}" for column in missing]
    return Suggestion("\n".join(lines) + "\n", tuple(missing))


def _table(file: Path) -> pa.Table:
    log_format = format_of(file)
    if log_format is None or log_format.columns is None:
        suffixes = [x.suffixes[0] for x in FORMATS if x.columns is not None]
        raise LogError(f"a file of kind {file.suffix!r}", file=file, expected=" or ".join(suffixes))
    return log_format.columns(file)


def _measured_columns(table: pa.Table) -> list[Column]:
    """Return the columns, and elements of columns of lists, whose names speak of a measured quantity."""
    columns: list[Column] = []
    for name in table.column_names:
        words = _words(name)
        quantity = _quantity(words)
        if quantity is None:
            continue
        length = _list_length(table[name])
        if length is None:
            numbers = re.findall(r"\d+", name)
            columns.append(Column(name, quantity, words, int(numbers[-1]) if numbers else None))
        for index in range(length or 0):
            columns.append(Column(f"{name}[{index}]", quantity, words, index))
    return columns


def _quantity(words: Collection[str]) -> str | None:
    # set points have the names of what they are set points of
    if not NOT_MEASURED.isdisjoint(words):
        return None
    for quantity, spoken in WORDS.items():
        if not spoken.isdisjoint(words):
            return quantity
    return None


def _joint_order(table: pa.Table, file: Path) -> list[str]:
    """Return the names of the joints in the order of lists; empty where the log does not name them.

    Raises LogError where the order changes from row to row.
    """
    for column in table.column_names:
        names = table[column]
        if column.strip("/").lower() not in JOINT_NAMES or _list_length(names) is None:
            continue
        # a mapping says one place for each joint: it cannot follow an order that changes
        orders = pa.compute.unique(names.cast(pa.string()) if _is_text(names) else names)
        if len(orders) > 1:
            raise LogError(
                f"{len(orders)} orders of joints", file=file, element=f"column {column}",
                expected="the same names in each row", do="sort each message's joints before it is written",
            )  # fmt: skip
        first = orders[0].as_py()
        if isinstance(first, str):
            return re.findall(r"[^\[\](),;'\"\s]+", first)
        return list(map(str, first))
    return []


def _words(name: str) -> tuple[str, ...]:
    """``field.jointPos0`` -> field, joint, pos."""
    separated = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name)
    return tuple(word.lower() for word in re.findall(r"[A-Za-z]+", separated))


def _is_text(values: pa.ChunkedArray) -> bool:
    return bool(pa.types.is_string(values.type) or pa.types.is_large_string(values.type))


def _list_length(values: pa.ChunkedArray) -> int | None:
    """Return how many elements the lists of a column have, written as text maybe; None for plain values."""
    valid = values.drop_null()
    first = valid[0].as_py() if len(valid) else None
    if isinstance(first, list):
        return len(first)
    if isinstance(first, str) and re.match(r"\s*(array\()?[^\[(]*[\[(]", first):
        inside = re.sub(r"^.*[\[(]|[\])].*$", "", first)
        return len(re.findall(r"[^\s,;]+", inside))
    return None


def _by_joint(
    columns: Sequence[Column], quantity: str, joints: Sequence[str], order: Sequence[str]
) -> dict[str, Column]:
    """Return the column of each joint: by its name, else by the order of lists, else by numbers in the URDF's order."""
    candidates = [column for column in columns if column.quantity == quantity]
    named: dict[str, Column] = {}
    for joint in joints:
        for column in candidates:
            if names_joint(column.name, joint):
                named[joint] = column
    if named:
        return named
    numbered = {column.number: column for column in candidates if column.number is not None}
    if order:
        for joint in joints:
            number = order.index(joint) if joint in order else None
            if number in numbered:
                named[joint] = numbered[number]
        return named
    if len(numbered) < len(joints):
        return {}
    return dict(zip(joints, map(numbered.__getitem__, sorted(numbered)), strict=False))


def _time_unit(clock: Column, table: pa.Table) -> str:
    """Return the unit of times that their name says, else that in which steps between samples are usual."""
    unit = _unit_in_names("t", [clock])
    if unit is not None:
        return unit
    try:
        steps = np.diff(table[clock.name].cast(pa.float64()).to_numpy())
    except (pa.ArrowException, KeyError):
        return "s"
    step = float(np.median(steps)) if len(steps) else 0.0
    for unit, largest in (("s", 0.5), ("ms", 500), ("us", 5e5)):  # no arm is sampled more slowly than at 2 Hz
        if step < largest:
            return unit
    return "ns"


def _unit_in_names(quantity: str, columns: Iterable[Column]) -> str | None:
    """Return the unit that the columns' names say."""
    words: set[str] = set()
    for column in columns:
        words.update(column.words)
    for word, unit in UNITS[quantity].items():
        if word in words:
            return unit
    return None


def _angle_units(
    columns: dict[str, dict[str, Column]],
    turning: Collection[str],
    table: pa.Table,
    file: Path,
    clock: str,
    time_scale: float,
) -> dict[str, str]:
    """Return degrees where positions of turning joints are no radians: of q, and of qd where that is its derivative."""
    positions = [x for joint, x in columns["q"].items() if joint in turning]
    speeds = [x for joint, x in columns["qd"].items() if joint in turning]
    unit, speed_unit = _unit_in_names("q", positions), _unit_in_names("qd", speeds)
    q = [column_values(table, x.name, file) for x in positions]
    if unit is None and any(np.ptp(x) > TURNS for x in q):
        unit = "deg"
    if unit == "deg" and speed_unit is None and len(speeds) == len(positions):
        dt = np.diff(column_values(table, clock, file)) * time_scale
        distance = sum(np.abs(np.diff(x)).sum() for x in q)
        integral = sum(np.abs(column_values(table, x.name, file)[1:] * dt).sum() for x in speeds)
        # 1 if speeds are in degrees as positions are, 57 if in radians: between the two
        if distance < 8 * integral:
            speed_unit = "deg/s"
    units = {"q": unit, "qd": speed_unit}
    return {quantity: unit for quantity, unit in units.items() if unit}
