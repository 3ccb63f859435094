"""Draft the mapping of a log that nobody has described, by the names of its columns.

Units that names do not say stay SI: the checks of logs find degrees and milliseconds, and say what to write.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa

from spelgen.errors import LogError, shortened
from spelgen.logs.formats import FORMATS, format_of
from spelgen.logs.tables import names_joint, reading
from spelgen.logs.tuning import TUNING

WORDS = {
    "t": {"t", "time", "times", "timestamp", "stamp", "clock", "ms", "us", "ns", "sec", "secs", "seconds", "millis"},
    "q": {"q", "pos", "position", "positions", "angle", "angles", "theta"},
    "qd": {"qd", "dq", "vel", "velocity", "velocities", "speed", "speeds", "omega"},
    "tau": {"tau", "torque", "torques", "effort", "efforts", "current", "currents", "amps", "curr", "moment"},
}  # fmt: skip
# set points have the names of what they are set points of
NOT_MEASURED = {"target", "desired", "command", "cmd", "reference", "ref", "setpoint", "goal", "error", "std"}
UNITS = {"ms": "ms", "millis": "ms", "us": "us", "ns": "ns", "mnm": "mNm", "ma": "mA"}
UNITS |= dict.fromkeys(("amps", "current", "currents", "curr"), "A")


class Suggestion(NamedTuple):
    """Hold a mapping as YAML text, with comments on what was assumed. missing: what no column was found for."""

    text: str
    missing: tuple[str, ...]


def suggest_mapping(file: Path, joints: Sequence[str]) -> Suggestion:
    """Return how a file may be read. Raises LogError where it cannot be opened, or has no column of times."""
    log_format = format_of(file)
    if log_format is None or log_format.columns is None:
        suffixes = [x.suffixes[0] for x in FORMATS if x.columns is not None]
        raise LogError(f"a file of kind {file.suffix!r}", file=file, expected=" or ".join(suffixes))
    with reading(file):
        names = _names(log_format.columns(file))
    measured: dict[str, list[str]] = {quantity: [] for quantity in WORDS}
    for name in names:
        name_words = _words(name)
        for quantity, words in WORDS.items():
            if name_words & words and not name_words & NOT_MEASURED:
                measured[quantity].append(name)
                break
    if not measured["t"]:
        got = f"only the columns {shortened(names, TUNING.listed)}"
        raise LogError(got, file=file, expected="one of times, called t or time")
    # `time` before `timestamp_of_receipt`: what has the fewest words is the plain clock
    clock = min(measured.pop("t"), key=lambda name: len(_words(name)))
    by_joint = {quantity: _by_joint(columns, joints) for quantity, columns in measured.items()}
    units = {"t": _unit([clock]) or "s"}
    torque_unit = _unit(by_joint["tau"].values())
    if torque_unit:
        units["tau"] = torque_unit
    lines = [
        f"# Drafted from the column names of {json.dumps(file.name)}: check it, and the order of the joints.",
        f"columns: {{t: {json.dumps(clock)}}}",
        f"units: {json.dumps(units)}",
    ]
    if len(by_joint["qd"]) < len(joints):
        lines.append("velocity: differentiated")
        del by_joint["qd"]
    lines.append("joints:")
    missing = []
    for joint in joints:
        entries = {quantity: named[joint] for quantity, named in by_joint.items() if joint in named}
        missing += [f"{quantity} of {joint}" for quantity in by_joint if quantity not in entries]
        lines += [f"  {json.dumps(joint)}:", f"    columns: {json.dumps(entries)}"]
        if torque_unit in ("A", "mA"):
            at_joint = "at the joint, the gear included: write its value"
            lines.append(f"    gain: 1.0 # Nm per {torque_unit} {at_joint}")
    lines += [f"# no column was found for {column}" for column in missing]
    return Suggestion("\n".join(lines) + "\n", tuple(missing))


def _unit(names: Iterable[str]) -> str | None:
    """Return the unit that columns' names say, the last of several."""
    unit = None
    for name in names:
        for word in reversed(UNITS):
            if word in _words(name):
                unit = UNITS[word]
    return unit


def _words(name: str) -> set[str]:
    """Return the words of a name: jointPos0 -> joint, pos."""
    separated = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name)
    return set(re.findall(r"[a-z]+", separated.lower()))


def _names(table: pa.Table) -> list[str]:
    """Return the names of all columns, and of columns of lists those of their elements."""
    names: list[str] = []
    for name in table.column_names:
        values = table[name].drop_null()
        if pa.types.is_nested(values.type) and len(values):
            names += [f"{name}[{index}]" for index in range(len(values[0]))]
        else:
            names.append(name)
    return names


def _by_joint(names: Sequence[str], joints: Sequence[str]) -> dict[str, str]:
    """Return the column of each joint: by its name, else by the last number, in the URDF's order."""
    named = {joint: name for joint in joints for name in names if names_joint(name, joint)}
    numbered: dict[int, str] = {}
    for name in names:
        numbers = re.findall(r"\d+", name)
        if numbers:
            numbered[int(numbers[-1])] = name
    if named or len(numbered) < len(joints):
        return named
    return dict(zip(joints, map(numbered.__getitem__, sorted(numbered)), strict=False))
