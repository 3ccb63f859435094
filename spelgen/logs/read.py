"""Log files <-> trajectories, in SI units and the URDF's senses: no filtering, no resampling, no repair."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from spelgen.errors import LogError, SpelgenError, collect
from spelgen.files import replacing
from spelgen.logs.arm_mapping import GivenMapping, log_source
from spelgen.logs.log_files import log_files
from spelgen.logs.mapping import TIMES, LogMapping
from spelgen.logs.readers import read_tables
from spelgen.logs.tables import UNITS, UNITS_KEY, LogTable, wanted_quantities
from spelgen.logs.trajectory import QUANTITIES, Trajectory, gap_ends, require_joints

ROW_GROUP = 2**16  # rows that are written together: a log too large for memory is read by them
EXACT = 2**53  # whole numbers up to here are exact as floating-point numbers

Named = tuple[tuple[str, str, str], Trajectory]
"""A trajectory and its possible names, from the shortest to the surely unique one."""


def read_logs(
    paths: Path | str | Iterable[Path | str],
    arm: Any,
    mapping: GivenMapping = None,
    role: str | None = None,
    *,
    joint_types: Sequence[str] | None = None,
) -> list[Trajectory]:
    """All trajectories of the given files and folders, in sorted order of their files.

    arm: one loaded from a URDF, a model, or the names of joints as the URDF has them; without a mapping, joint j
    has the columns `q_<j>`, `qd_<j>`, `tau_<j>`, beside the time `t` [s]. A column `trajectory` splits one file
    into several. mapping: how the logs are named and measured, as a LogMapping, its keys in a dict, or a YAML file
    of them; by default what the settings beside the arm's URDF say under `logs`. role "train" or "test": of a folder
    that holds train.* or test.* files, only those with this stem are read. joint_types: what the mapping's units are
    checked against, where `arm` is names alone.
    Raises LogError (or one error that holds several) naming file, row and column, and SettingsError where
    the mapping does not fit the joints.
    """
    joints, kinds, how = log_source(arm, mapping)
    collect(how.misfits(joints, kinds or joint_types))
    errors: list[SpelgenError] = []
    labelled: list[Named] = []
    for file in log_files(paths, role, errors):
        try:
            for each in read_tables(file, joints, how):
                labelled += _trajectories(each, file, joints)
        except LogError as error:
            errors.append(error)
    collect(errors)
    return _with_unique_names(labelled)


def write_logs(path: Path | str, trajectories: Sequence[Trajectory], arm: Any) -> Path:
    """Write one Parquet or CSV file (by suffix) with a `trajectory` column, all or nothing; return the path.

    arm: as for `read_logs`, which gives the same numbers back from either. Parquet files declare their units.
    Raises LogError for another suffix, without trajectories, and for those of another number of joints.
    """
    path, joints = Path(path), log_source(arm).joints
    write = _writer(path)
    if not trajectories:
        raise LogError("no trajectory", file=path, expected="at least one")
    for trajectory in trajectories:
        require_joints(trajectory, joints)
    columns: dict[str, np.ndarray | list[str]] = {
        "trajectory": [x.name for x in trajectories for _ in x.t],
        "t": np.concatenate([x.t for x in trajectories]),
    }
    for quantity in QUANTITIES:
        values = np.concatenate([getattr(x, quantity) for x in trajectories])
        columns |= {f"{quantity}_{joint}": values[:, i] for i, joint in enumerate(joints)}
    table = pa.table(columns).replace_schema_metadata({UNITS_KEY: UNITS})
    with replacing(path) as unfinished:
        write(table, unfinished)
    return path


def _writer(path: Path) -> Callable[[pa.Table, Path], None]:
    writers: dict[str, Callable[[pa.Table, Path], None]] = {
        ".parquet": partial(pa.parquet.write_table, row_group_size=ROW_GROUP),
        ".csv": pa.csv.write_csv,
    }
    if path.suffix not in writers:
        raise LogError(f"a log named {path.name!r}", expected=" or ".join(writers))
    return writers[path.suffix]


def _trajectories(part: LogTable, file: Path, joints: Sequence[str]) -> list[Named]:
    """The trajectories of one table."""
    if not part.table.num_rows:
        raise LogError("no rows", file=file, expected="at least one window of samples")
    values = in_si(table_values(part, file, clock_start(part)), joints, part.mapping)
    declared = part.declares_units or all(part.mapping.unit("q", joint) for joint in joints)
    found = []
    for name, rows in _recordings(part, file.stem):
        require_increasing_times(values["t"][rows], rows, file, part.wanted[0])
        trajectory = made_trajectory(values, rows, name=name, file=file, declares_units=declared)
        found.append(((name, f"{file.stem}/{name}", f"{file}/{name}"), trajectory))
    return found


def _recordings(part: LogTable, stem: str) -> list[tuple[str, np.ndarray]]:
    """Name and rows of each recording of a table, in order of their first rows."""
    if part.labels is None:
        return [(part.recording or stem, np.arange(part.table.num_rows))]
    places: dict[str, int] = {}
    codes = [places.setdefault(str(label), len(places)) for label in part.table[part.labels].to_pylist()]
    order = np.argsort(codes, kind="stable")
    return list(zip(places, np.split(order, np.cumsum(np.bincount(codes))[:-1]), strict=True))


def in_si(data: np.ndarray, joints: Sequence[str], mapping: LogMapping) -> dict[str, np.ndarray]:
    """Columns as logged, t, q, qd (where it is logged) and tau by joint (T, 1 + 3n or 2n) -> each in SI units."""
    logged = wanted_quantities(mapping)
    values = dict(zip(logged, np.split(data[:, 1:], len(logged), axis=1), strict=True))
    for quantity, columns in values.items():
        factors = np.array([mapping.scale(quantity, joint) for joint in joints])
        offsets = np.array([mapping.offset(quantity, joint) for joint in joints])
        values[quantity] = columns * factors + offsets
    return values | {"t": data[:, 0] * TIMES[mapping.units.t]}


def made_trajectory(values: dict[str, np.ndarray], rows: np.ndarray | slice, **about: Any) -> Trajectory:
    """These rows of what `in_si` gave, velocities differentiated where there are none. about: the trajectory."""
    t, q, tau = (values[name][rows] for name in ("t", "q", "tau"))
    qd = values["qd"][rows] if "qd" in values else _differentiated(t, q)
    return Trajectory(t, q, qd, tau, **about)


def _differentiated(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Central differences (T, n) within each gap-free piece; 0 for a sample alone, of which no window is cut."""
    qd = np.zeros_like(q)
    for start, stop in pairwise(gap_ends(t)):
        if stop - start > 1:
            qd[start:stop] = np.gradient(q[start:stop], t[start:stop], axis=0)
    return qd


def clock_start(part: LogTable) -> int:
    """From where times count: the first one of a clock too wide for floating-point numbers, else 0."""
    first = part.table[part.wanted[0]][:1]
    if pa.types.is_timestamp(first.type):
        return first.cast(pa.timestamp("ns")).cast(pa.int64())[0].as_py() or 0
    wide = pa.types.is_integer(first.type) and abs(first[0].as_py() or 0) > EXACT
    return first[0].as_py() if wide else 0


def table_values(part: LogTable, file: Path, start: int, row: int = 0) -> np.ndarray:
    """The wanted columns as logged (T, 1 + 3n or 2n), times from `start` on. row: of the table in its file."""
    data = np.stack([_numbers(part, column, file, start) for column in part.wanted], axis=1)
    require_finite(data, part.wanted, file, row)
    return data


def _numbers(part: LogTable, column: str, file: Path, start: int) -> np.ndarray:
    """A column as float64 (T,)."""
    values = part.table[column]
    try:
        if column == part.wanted[0]:
            if pa.types.is_timestamp(values.type):
                nanoseconds = values.cast(pa.timestamp("ns")).cast(pa.int64()).to_numpy()
                return (nanoseconds - start) * 1e-9 / TIMES[part.mapping.units.t]
            if start:
                return (values.to_numpy() - start).astype(float)
        return values.cast(pa.float64()).to_numpy()
    except (pa.ArrowException, ValueError) as error:
        kind = part.table.schema.field(column).type
        raise LogError(
            f"values of type {kind}", file=file, element=f"column {column}", expected="numbers"
        ) from error


def require_finite(data: np.ndarray, columns: Sequence[str], file: Path, first: int = 0) -> None:
    """Raise LogError where a column of the data (T, C), from row `first` of the file on, is not finite."""
    bad = ~np.isfinite(data)
    if bad.any():
        row, column = np.argwhere(bad)[0] + (first, 0)
        count = int(bad.any(axis=1).sum())
        raise LogError(
            f"no finite number ({count} of {len(data)} rows have such a gap, this is the first)",
            file=file, line=_line(file, row), element=f"row {row + 1}, column {columns[column]}",
            expected="a number", do="remove those rows; a gap in t is understood",
        )  # fmt: skip


def require_increasing_times(t: np.ndarray, rows: np.ndarray, file: Path, column: str) -> None:
    """Raise LogError unless times (T,), of these rows of the file, increase."""
    back = np.flatnonzero(np.diff(t) <= 0)
    if back.size:
        k = int(back[0])
        raise LogError(
            f"t = {t[k + 1]:g} s after {t[k]:g} s ({back.size} such steps, this is the first)",
            file=file, line=_line(file, rows[k + 1]), element=f"row {rows[k + 1] + 1}, column {column}",
            expected="increasing times",
            do="sort the rows, drop repeats, or split recordings by a column 'trajectory'",
        )  # fmt: skip


def _line(file: Path, row: int) -> int | None:
    """The line of a 0-based data row, where the format has lines (a CSV's first is its header)."""
    return int(row) + 2 if file.suffix == ".csv" else None


def _with_unique_names(labelled: Sequence[Named]) -> list[Trajectory]:
    for level in range(3):
        names = [labels[level] for labels, _ in labelled]
        if len(set(names)) == len(names):
            break
    return [replace(x, name=name) for name, (_, x) in zip(names, labelled, strict=True)]
