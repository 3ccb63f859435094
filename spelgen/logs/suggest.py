"""Columns of a log without known names -> the mapping by which it is read, as far as names and numbers tell."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.parquet

from spelgen.errors import LogError
from spelgen.logs.npz import npz_table
from spelgen.logs.readers import read_csv
from spelgen.logs.tables import opened
from spelgen.logs.trajectory import QUANTITIES
from spelgen.logs.values import column_values
from spelgen.settings.log_mapping import TIMES

WORDS = {
    "t": {
        "t",
        "time",
        "times",
        "timestamp",
        "stamp",
        "clock",
        "ms",
        "us",
        "ns",
        "sec",
        "secs",
        "seconds",
        "millis",
    },
    "q": {"q", "pos", "position", "positions", "angle", "angles", "theta"},
    "qd": {"qd", "dq", "vel", "velocity", "velocities", "speed", "speeds", "omega"},
    "tau": {"tau", "torque", "torques", "effort", "efforts", "current", "currents", "amps", "curr", "moment"},
}
NOT_MEASURED = {"target", "desired", "command", "cmd", "reference", "ref", "setpoint", "goal", "error", "std"}
NAMES = ("name", "names", "joint_names", "joints")
UNITS = {
    "t": {"ms": "ms", "millis": "ms", "us": "us", "ns": "ns"},
    "q": {"deg": "deg", "degree": "deg", "degrees": "deg", "mm": "mm"},
    "qd": {"deg": "deg/s", "degrees": "deg/s", "dps": "deg/s", "rpm": "rpm", "mm": "mm/s"},
    "tau": {
        "mnm": "mNm",
        "amps": "A",
        "ampere": "A",
        "current": "A",
        "currents": "A",
        "curr": "A",
        "ma": "mA",
    },
}
TURNS = 4 * np.pi  # no revolute joint turns further, so what does is in degrees


@dataclass(frozen=True)
class Column:
    """A column, or a place of a column of lists. quantity: t, q, qd or tau. number: the last one in its name."""

    name: str
    quantity: str
    words: tuple[str, ...]
    number: int | None


@dataclass(frozen=True)
class Suggestion:
    """A mapping as YAML text, with comments on what was assumed. missing: what no column was found for."""

    text: str
    missing: tuple[str, ...]


def suggest_mapping(file: Path, joints: Sequence[str], joint_types: Sequence[str]) -> Suggestion:
    """How a file may be read. Raises LogError where it cannot be opened, or has no column of times."""
    table = _table(file)
    columns, listed = _columns(table, file)
    times = [each for each in columns if each.quantity == "t"]
    if not times:
        names = ", ".join(table.column_names)
        raise LogError(f"only the columns {names}", file=file, expected="one of times, called t or time")
    clock = min(times, key=lambda each: len(each.words))
    found = {what: _by_joint(columns, what, joints, listed) for what in QUANTITIES}
    units = {"t": _time_unit(clock, table)}
    turning = [joint for joint, kind in zip(joints, joint_types, strict=True) if kind == "revolute"]
    angles = _angle_units(found, turning, table, file, clock, units["t"])
    if len(turning) == len(joints):
        units |= angles
    torque = _said_unit("tau", found["tau"].values())
    units |= {"tau": torque} if torque else {}
    missing = [f"{what} of {joint}" for what in ("q", "tau") for joint in joints if joint not in found[what]]
    differentiated = len(found["qd"]) < len(joints)
    lines = [
        "# Read off the names and numbers of " + json.dumps(file.name) + ": check it before you rely on it."
    ]
    if not listed and not any(_speaks_of(each, joint) for each in found["q"].values() for joint in joints):
        lines.append("# Joints are taken in the URDF's order: the log does not name them.")
    lines += [f"columns: {{t: {json.dumps(clock.name)}}}", f"units: {json.dumps(units)}"]
    lines += ["velocity: differentiated"] if differentiated else []
    lines.append("joints:")
    for joint in joints:
        own = {what: found[what][joint].name for what in QUANTITIES if joint in found[what]}
        if differentiated:
            own.pop("qd", None)
        lines += [f"  {json.dumps(joint)}:", f"    columns: {json.dumps(own)}"]
        if angles and joint in turning and len(turning) < len(joints):
            lines.append(f"    units: {json.dumps(angles)}")
        if units.get("tau") in ("A", "mA"):
            lines.append(
                f"    gain: 1.0 # Nm per {units['tau']} at the joint, the gear included: say what it is"
            )
    lines += [f"# no column was found for {each}" for each in missing]
    return Suggestion("\n".join(lines) + "\n", tuple(missing))


def _table(file: Path) -> pa.Table:
    if file.suffix == ".parquet":
        return opened(file, lambda: pa.parquet.read_table(file))
    if file.suffix == ".npz":
        return npz_table(file)
    if file.suffix == ".csv":
        return opened(file, lambda: read_csv(file))
    raise LogError(f"a file of kind {file.suffix!r}", file=file, expected=".csv, .parquet or .npz")


def _columns(table: pa.Table, file: Path) -> tuple[list[Column], list[str]]:
    """What may be meant by the columns, and the names of the joints in the order of lists, where lists are named."""
    found: list[Column] = []
    for name in table.column_names:
        words = _words(name)
        quantity = next((what for what, known in WORDS.items() if known & set(words)), None)
        if quantity is None or NOT_MEASURED & set(words):
            continue
        places = _places(table[name])
        numbers = re.findall(r"\d+", name)
        if places is None:
            found.append(Column(name, quantity, words, int(numbers[-1]) if numbers else None))
        else:
            found += [Column(f"{name}[{k}]", quantity, words, k) for k in range(places)]
    named = next((name for name in table.column_names if name.strip("/").lower() in NAMES), None)
    if named is None or _places(table[named]) is None:
        return found, []
    texts = pa.compute.unique(table[named].cast(pa.string()) if _is_text(table[named]) else table[named])
    if len(texts) > 1:
        raise LogError(
            f"{len(texts)} orders of joints", file=file, element=f"column {named}",
            expected="the same names in each row", do="sort each message's joints before it is written",
        )  # fmt: skip
    first = texts[0].as_py()
    return found, re.findall(r"[^\[\](),;'\"\s]+", first) if isinstance(first, str) else list(map(str, first))


def _words(name: str) -> tuple[str, ...]:
    """``field.jointPos0`` -> field, joint, pos."""
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name)
    return tuple(word.lower() for word in re.findall(r"[A-Za-z]+", apart))


def _is_text(values: pa.ChunkedArray) -> bool:
    return pa.types.is_string(values.type) or pa.types.is_large_string(values.type)


def _places(values: pa.ChunkedArray) -> int | None:
    """How many places the lists of a column have; None for plain values."""
    first = next((each.as_py() for each in values if each.is_valid), None)
    if isinstance(first, list):
        return len(first)
    if isinstance(first, str) and re.match(r"\s*(array\()?[^\[(]*[\[(]", first):
        return len(re.findall(r"[^\s,;]+", re.sub(r"^.*[\[(]|[\])].*$", "", first)))
    return None


def _speaks_of(column: Column, joint: str) -> bool:
    return re.search(rf"(?<![0-9a-z]){re.escape(joint)}(?![0-9a-z])", column.name, re.IGNORECASE) is not None


def _by_joint(
    columns: Sequence[Column], quantity: str, joints: Sequence[str], listed: Sequence[str]
) -> dict[str, Column]:
    """The column of each joint: by its name, else by the order of lists, else by numbers in the URDF's order."""
    of_it = [each for each in columns if each.quantity == quantity]
    found = {joint: each for joint in joints for each in of_it if _speaks_of(each, joint)}
    if found:
        return found
    numbered = sorted((each for each in of_it if each.number is not None), key=lambda each: each.number or 0)
    if listed:
        places = {name: k for k, name in enumerate(listed)}
        return {joint: x for joint in joints for x in numbered if x.number == places.get(joint)}
    return dict(zip(joints, numbered, strict=False)) if len(numbered) >= len(joints) else {}


def _time_unit(clock: Column, table: pa.Table) -> str:
    said = next((UNITS["t"][word] for word in clock.words if word in UNITS["t"]), None)
    if said:
        return said
    try:
        steps = np.diff(table[clock.name].cast(pa.float64()).to_numpy())
    except (pa.ArrowException, KeyError):
        return "s"
    step = float(np.median(steps)) if len(steps) else 0.0
    return "s" if step < 0.5 else "ms" if step < 500 else "us" if step < 5e5 else "ns"


def _said_unit(quantity: str, columns: Iterable[Column]) -> str | None:
    """The unit that the columns' names say."""
    words = {word for each in columns for word in each.words}
    return next((unit for word, unit in UNITS[quantity].items() if word in words), None)


def _angle_units(
    found: Mapping[str, Mapping[str, Column]],
    turning: Sequence[str],
    table: pa.Table,
    file: Path,
    clock: Column,
    time_unit: str,
) -> dict[str, str]:
    """Degrees, where positions of turning joints are no radians: of q, and of qd where that is its derivative."""
    places, speeds = ({k: x for k, x in found[what].items() if k in turning} for what in ("q", "qd"))
    values = {joint: column_values(table, each.name, file) for joint, each in places.items()}
    said, speed = _said_unit("q", places.values()), _said_unit("qd", speeds.values())
    degrees = said == "deg" or (said is None and any(np.ptp(x) > TURNS for x in values.values()))
    if speed is None and degrees and speeds.keys() == places.keys():
        dt = np.diff(column_values(table, clock.name, file)) * TIMES[time_unit]
        moved = sum(np.abs(np.diff(x)).sum() for x in values.values())
        meant = sum(np.abs(column_values(table, x.name, file)[1:] * dt).sum() for x in speeds.values())
        speed = "deg/s" if moved < 8 * meant else None  # between 1 and 180 / pi
    units = {"q": "deg" if degrees else said, "qd": speed}
    return {what: unit for what, unit in units.items() if unit}
