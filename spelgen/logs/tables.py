"""Log files -> tables of the columns that an arm needs, one reader for each kind of file."""

from __future__ import annotations

import difflib
import re
import zipfile
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from spelgen.errors import LogError
from spelgen.logs.bags import SUFFIXES as BAG_SUFFIXES
from spelgen.logs.bags import is_bag, read_bag
from spelgen.logs.mapping import PLAIN, LogMapping
from spelgen.logs.trajectory import QUANTITIES

SUFFIXES = (".parquet", ".csv", ".npz", *BAG_SUFFIXES)
NAMES = "joints"  # an NPZ file's array of joint names, by the columns of its matrices
UNITS_KEY = b"units"  # in a Parquet file's metadata: the file declares its units
UNITS = b"t s, q rad or m, qd rad/s or m/s, tau Nm or N"  # what spelgen itself declares

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
    """Whether there is a reader for this file or folder."""
    return is_bag(path) if path.is_dir() else path.suffix in SUFFIXES


def wanted_quantities(mapping: LogMapping) -> tuple[str, ...]:
    """The quantities that a log must hold."""
    return tuple(x for x in QUANTITIES if x != "qd" or mapping.velocity == "logged")


def read_tables(file: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """The tables of one file. Raises LogError, where columns are missing too.

    A Parquet file that spelgen itself wrote is read as such, whatever the mapping says.
    """
    if is_bag(file):
        return [_bag(file, joints, mapping)]
    if file.suffix == ".npz":
        return _npz(file, joints, mapping)
    if file.suffix == ".parquet":
        return [_parquet(file, joints, mapping)]
    table = opened(file, lambda: pa.csv.read_csv(file))
    names = wanted_names(joints, mapping)
    require_columns(table.column_names, names, file, mapping)
    return [LogTable(None, table, names, mapping, labels_among(table.column_names, mapping))]


def _parquet(file: Path, joints: Sequence[str], mapping: LogMapping) -> LogTable:
    schema, mapping = read_schema(file, mapping)
    names, labels = wanted_names(joints, mapping), labels_among(schema.names, mapping)
    require_columns(schema.names, names, file, mapping)
    read = [*names, *filter(None, [labels])]
    return LogTable(
        None, opened(file, lambda: pa.parquet.read_table(file, columns=read)), names, mapping, labels
    )


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
        raise _missing(missing, present, file, mapping)


def _missing(missing: Sequence[str], present: Collection[str], file: Path, mapping: LogMapping) -> LogError:
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
    except (pa.ArrowException, OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
        raise LogError(f"an unreadable {file.suffix[1:]} file ({reason})", file=file) from error


def labels_among(present: Collection[str], mapping: LogMapping) -> str | None:
    """The column that splits a table into recordings, where there is one."""
    return mapping.columns.trajectory if mapping.columns.trajectory in present else None


def _bag(file: Path, joints: Sequence[str], mapping: LogMapping) -> LogTable:
    table = read_bag(file, [mapping.log_name(joint) for joint in joints], mapping.topic)
    plain = {x: PLAIN[x].replace("{joint}", "{}") for x in wanted_quantities(mapping)}
    names = [form.format(mapping.log_name(joint)) for form in plain.values() for joint in joints]
    require_columns(table.column_names, ["t", *names], file, LogMapping())
    return LogTable(None, table, ("t", *names), mapping)


def _npz(file: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """One recording, or one for each text that `{trajectory}` stands for in the name of the times."""
    arrays: dict[str, np.ndarray] = opened(file, lambda: dict(np.load(file, allow_pickle=False)))
    if "{trajectory}" not in mapping.columns.t:
        return [_npz_table(None, arrays, file, joints, mapping)]
    pattern = re.compile(re.escape(mapping.columns.t).replace(r"\{trajectory\}", "(.+)"))
    texts = [match[1] for match in map(pattern.fullmatch, arrays) if match]
    if not texts:
        raise _missing([mapping.columns.t], arrays, file, mapping)
    return [_npz_table(text, arrays, file, joints, mapping.of_trajectory(text)) for text in texts]


def _npz_table(
    text: str | None, arrays: dict[str, np.ndarray], file: Path, joints: Sequence[str], mapping: LogMapping
) -> LogTable:
    """Each column an array of its own, or a column of a matrix: `q` (T, n) stands for all `q_<joint>`."""
    found = {mapping.columns.t: arrays[mapping.columns.t]} if mapping.columns.t in arrays else {}
    names = [mapping.columns.t]
    for quantity in wanted_quantities(mapping):
        pattern: str = getattr(mapping.columns, quantity)
        matrix = pattern.replace("{joint}", "").rstrip("_")
        for index, joint in enumerate(joints):
            name = mapping.column(quantity, joint)
            if matrix in arrays and arrays[matrix].ndim == 2:
                at = _place(arrays, index, mapping.log_name(joint), matrix, len(joints), file)
                name = f"{matrix}[:, {at}]"
                found[name] = arrays[matrix][:, at]
            elif name in arrays:
                found[name] = arrays[name]
            names.append(name)
    if missing := [name for name in names if name not in found]:
        raise _missing(missing, arrays, file, mapping)
    _require_samples(found, file)
    labels = mapping.columns.trajectory
    if text is None and labels in arrays:
        found[labels] = arrays[labels]
    return LogTable(text, pa.table(found), tuple(names), mapping, labels if labels in found else None)


def _place(arrays: dict[str, np.ndarray], index: int, name: str, matrix: str, joints: int, file: Path) -> int:
    """The column of a joint in a matrix: as the array `joints` says, else in the order of the arm's joints."""
    columns = arrays[matrix].shape[1]
    known = [str(each) for each in arrays[NAMES].ravel()] if NAMES in arrays else None
    if known is None and columns != joints:
        raise LogError(
            f"{columns} columns", file=file, element=f"array {matrix}", expected=f"{joints}, one for each joint",
            do=f"name them by an array {NAMES!r}",
        )  # fmt: skip
    if known is not None and (name not in known or len(known) != columns):
        raise LogError(
            f"the joints {', '.join(known)}", file=file, element=f"array {NAMES}",
            expected=f"{name} among the names of the {columns} columns of {matrix}",
        )  # fmt: skip
    return index if known is None else known.index(name)


def _require_samples(found: dict[str, np.ndarray], file: Path) -> None:
    samples = next(iter(found.values())).shape
    for name, array in found.items():
        if array.ndim != 1 or array.shape != samples:
            raise LogError(
                f"an array of shape {array.shape}", file=file, element=f"array {name}",
                expected=f"a value for each of the {samples[0] if samples else 0} times",
            )  # fmt: skip
