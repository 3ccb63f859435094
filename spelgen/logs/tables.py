"""What every reader of log files gives: a table with the columns that an arm needs, or one clear sentence."""

from __future__ import annotations

import difflib
import zipfile
import zlib
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import pyarrow as pa
import pyarrow.parquet

from spelgen.errors import LogError
from spelgen.logs.bags import SUFFIXES as BAG_SUFFIXES
from spelgen.logs.bags import is_bag
from spelgen.logs.mapping import LogMapping
from spelgen.logs.trajectory import QUANTITIES

SUFFIXES = (".parquet", ".csv", ".npz", *BAG_SUFFIXES)
UNITS_KEY = b"units"  # in a Parquet file's metadata: the file declares its units
UNITS = b"t s, q rad or m, qd rad/s or m/s, tau Nm or N"  # what spelgen itself declares

UNREADABLE = (pa.ArrowException, OSError, ValueError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error)

Content = TypeVar("Content")


@dataclass(frozen=True, eq=False)
class LogTable:
    """Part of a log file, with the file's own names, types and units.

    recording: its name, where the kind of file keeps recordings apart. wanted: the columns of t, then of q,
    qd and tau by joint; without qd where velocities are to be differentiated. labels: the column that splits
    the table into recordings, None without. mapping: what names and units were taken from.
    """

    recording: str | None
    table: pa.Table
    wanted: tuple[str, ...]
    mapping: LogMapping
    labels: str | None = None

    @property
    def declares_units(self) -> bool:
        return UNITS_KEY in (self.table.schema.metadata or {})


def is_log(path: Path) -> bool:
    """Whether there is a reader for this file or folder; what is neither, a pipe or a device, might never end."""
    return is_bag(path) if path.is_dir() else path.suffix in SUFFIXES and path.is_file()


def wanted_quantities(mapping: LogMapping) -> tuple[str, ...]:
    """The quantities that a log must hold."""
    return tuple(x for x in QUANTITIES if x != "qd" or mapping.velocity == "logged")


def read_schema(file: Path, mapping: LogMapping) -> tuple[pa.Schema, LogMapping]:
    """A Parquet file's columns, and the mapping that holds for it."""
    schema = opened(file, lambda: pa.parquet.read_schema(file))
    ours = (schema.metadata or {}).get(UNITS_KEY) == UNITS
    return schema, LogMapping() if ours else mapping


def wanted_names(joints: Sequence[str], mapping: LogMapping) -> tuple[str, ...]:
    """The columns of a table that joints are read from."""
    quantities = wanted_quantities(mapping)
    return (mapping.columns.t, *(mapping.column(what, joint) for what in quantities for joint in joints))


def require_columns(present: Sequence[str], wanted: Sequence[str], file: Path, mapping: LogMapping) -> None:
    """Raise LogError unless each of the wanted columns is there, once."""
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
    missing = [name for name in wanted if name not in present]
    if missing:
        raise missing_columns(missing, present, file, mapping)


def missing_columns(
    missing: Sequence[str], present: Collection[str], file: Path, mapping: LogMapping
) -> LogError:
    close = difflib.get_close_matches(missing[0], present, n=1)
    advice = "rename the columns, or say their names under 'logs' in the robot's YAML"
    if close:
        advice = f"rename the column {close[0]!r} to {missing[0]!r}?"
    columns = mapping.columns
    expected = [columns.t, *(getattr(columns, x).replace("{joint}", "<joint>") for x in QUANTITIES)]
    return LogError(
        f"only the columns {', '.join(present)}", file=file,
        element=f"missing column{'s' * (len(missing) > 1)} {', '.join(missing)}",
        expected=", ".join(expected), do=advice,
    )  # fmt: skip


def opened(file: Path, read: Callable[[], Content]) -> Content:
    """What `read` gives; LogError where the file is not of its kind."""
    try:
        return read()
    except UNREADABLE as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
        raise LogError(f"an unreadable {file.suffix[1:]} file ({reason})", file=file) from error


def labels_among(present: Collection[str], mapping: LogMapping) -> str | None:
    """The column that splits a table into recordings, where there is one."""
    return mapping.columns.trajectory if mapping.columns.trajectory in present else None
