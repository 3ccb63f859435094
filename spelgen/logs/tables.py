"""What every reader of log files gives: a table, and where in it an arm's quantities stand; or one clear sentence."""

from __future__ import annotations

import difflib
import re
import zipfile
import zlib
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
import pyarrow as pa

from spelgen.errors import LogError, shortened
from spelgen.logs.bags import SUFFIXES as BAG_SUFFIXES
from spelgen.logs.bags import is_bag
from spelgen.logs.lerobot import is_dataset
from spelgen.logs.trajectory import QUANTITIES
from spelgen.settings.log_mapping import TIMES, LogMapping

SUFFIXES = (".parquet", ".csv", ".npz", *BAG_SUFFIXES)
LISTED = 12  # columns, at most
UNITS_KEY = b"units"  # in a Parquet file's metadata: the file declares its units
UNITS = b"t s, q rad or m, qd rad/s or m/s, tau Nm or N"  # what spelgen itself declares

UNREADABLE = (pa.ArrowException, OSError, ValueError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error)

Content = TypeVar("Content")


@dataclass(frozen=True)
class Layout:
    """Where the quantities of an arm stand in a log, and how they are measured.

    columns: of t, then of q, qd and tau by joint; without qd where velocities are to be differentiated. labels: the
    column that splits the log into recordings, None without. declares_units: the file or the mapping says units.
    """

    columns: tuple[str, ...]
    labels: str | None
    joints: tuple[str, ...]
    mapping: LogMapping
    declares_units: bool

    @cached_property
    def units(self) -> tuple[np.ndarray, np.ndarray]:
        """Factors and offsets (C,) of the columns: a logged value in SI units is factor * value + offset."""
        pairs = [(what, joint) for what in wanted_quantities(self.mapping) for joint in self.joints]
        factors = [TIMES[self.mapping.units.t], *(self.mapping.scale(*each) for each in pairs)]
        return np.array(factors), np.array([0.0, *(self.mapping.offset(*each) for each in pairs)])


@dataclass(frozen=True, eq=False)
class LogTable:
    """Part of a log file. recording: its name, where the kind of file keeps recordings apart."""

    recording: str | None
    table: pa.Table
    layout: Layout


def is_log(path: Path) -> bool:
    """Whether there is a reader for this file or folder; what is neither, a pipe or a device, might never end."""
    return is_bag(path) or is_dataset(path) if path.is_dir() else path.suffix in SUFFIXES and path.is_file()


def wanted_quantities(mapping: LogMapping) -> tuple[str, ...]:
    """The quantities that a log must hold."""
    if mapping.input == "position":
        return ("q", "u")
    return tuple(x for x in QUANTITIES if x != "qd" or mapping.velocity == "logged")


def table_layout(schema: pa.Schema, joints: Sequence[str], mapping: LogMapping, file: Path) -> Layout:
    """Where a table's columns are. Raises LogError where one is missing, or there twice.

    What spelgen itself wrote is read as such, whatever the mapping says.
    """
    metadata = schema.metadata or {}
    if metadata.get(UNITS_KEY) == UNITS:
        mapping = LogMapping(input=mapping.input)
    quantities = wanted_quantities(mapping)
    columns = (mapping.columns.t, *(mapping.column(what, joint) for what in quantities for joint in joints))
    _require_columns(schema.names, columns, file, mapping, joints)
    labels = mapping.columns.trajectory if mapping.columns.trajectory in schema.names else None
    if labels and pa.types.is_nested(schema.field(labels).type):
        kind = schema.field(labels).type
        raise LogError(f"values of type {kind}", file=file, element=f"column {labels}", expected="names")
    return made_layout(columns, labels, joints, mapping, declared=UNITS_KEY in metadata)


def made_layout(
    columns: Sequence[str],
    labels: str | None,
    joints: Sequence[str],
    mapping: LogMapping,
    *,
    declared: bool = False,
) -> Layout:
    """A layout; declared: the file itself says what its units are."""
    said = declared or all(mapping.unit("q", joint) for joint in joints)
    return Layout(tuple(columns), labels, tuple(joints), mapping, said)


def element(name: str, present: Collection[str]) -> tuple[str, int] | None:
    """The column of lists and the place in them that a name like `position[2]` speaks of; None for other names."""
    match = re.fullmatch(r"(.+)\[(\d{1,3})\]", name)
    return (match[1], int(match[2])) if match and name not in present and match[1] in present else None


def stored_columns(layout: Layout, present: Collection[str]) -> list[str]:
    """The columns of a file that hold a layout's, each once."""
    names = [x for x in (*layout.columns, layout.labels) if x]
    return list(dict.fromkeys(found[0] if (found := element(x, present)) else x for x in names))


def _require_columns(
    present: Sequence[str], wanted: Sequence[str], file: Path, mapping: LogMapping, joints: Sequence[str]
) -> None:
    shared = sorted({name for name in wanted if wanted.count(name) > 1})
    if shared:
        raise LogError(
            "one column for several joints", file=file, element=f"column {', '.join(shared)}",
            expected="'{joint}' in its name under 'logs'",
        )  # fmt: skip
    repeated = sorted({name for name in wanted if present.count(name) > 1})
    if repeated:
        raise LogError(
            "the same column twice", file=file, element=f"column {', '.join(repeated)}", expected="it once"
        )
    missing = [name for name in wanted if name not in present and not element(name, present)]
    if missing:
        raise missing_columns(missing, present, file, mapping, joints)


def missing_columns(
    missing: Sequence[str], present: Collection[str], file: Path, mapping: LogMapping, joints: Sequence[str]
) -> LogError:
    """What is told of columns that are not there."""
    columns = mapping.columns
    expected = [
        columns.t,
        *(getattr(columns, x).replace("{joint}", "<joint>") for x in wanted_quantities(mapping)),
    ]
    return LogError(
        f"only the columns {shortened(list(present), LISTED)}", file=file,
        element=f"missing column{'s' * (len(missing) > 1)} {shortened(missing, LISTED)}",
        expected=", ".join(expected), do=_advice(missing, present, mapping, joints),
    )  # fmt: skip


def _advice(
    missing: Sequence[str], present: Collection[str], mapping: LogMapping, joints: Sequence[str]
) -> str:
    """What to do; a column is offered only where it names the same joint and is not another quantity's."""
    owner = {
        mapping.column(what, joint): (what, joint) for what in wanted_quantities(mapping) for joint in joints
    }
    if all(owner.get(name, ("", ""))[0] == "qd" for name in missing):
        return "say 'velocity: differentiated' under 'logs' in the robot's YAML where none were logged"
    joint = mapping.log_name(owner[missing[0]][1]) if missing[0] in owner else ""
    named = re.compile(rf"(?<![0-9a-z]){re.escape(joint)}(?![0-9a-z])", re.IGNORECASE)
    for close in difflib.get_close_matches(missing[0], [x for x in present if x not in owner], n=5):
        if named.search(close):
            return f"rename the column {close!r} to {missing[0]!r}?"
    return (
        "rename the columns, or say their names under 'logs' in the robot's YAML: "
        "`spelgen logs LOGS --robot ROBOT.urdf --suggest FILE` drafts them"
    )


def opened(file: Path, read: Callable[[], Content]) -> Content:
    """What `read` gives; LogError where the file is not of its kind."""
    try:
        return read()
    except UNREADABLE as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
        raise LogError(f"an unreadable {file.suffix[1:]} file ({reason})", file=file) from error
