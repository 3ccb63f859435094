"""Log files <-> trajectories, in SI units and the URDF's senses: no filtering, no resampling, no repair."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
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
from spelgen.logs.readers import read_tables
from spelgen.logs.tables import UNITS, UNITS_KEY, LogTable
from spelgen.logs.trajectory import Trajectory, require_joints
from spelgen.logs.values import clock_start, made_trajectory, require_increasing_times, values_in_si

ROW_GROUP = 2**16  # rows that are written together: a log too large for memory is read by them

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
                labelled += _trajectories(each, file)
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
    for quantity in trajectories[0].quantities:
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


def _trajectories(part: LogTable, file: Path) -> list[Named]:
    """The trajectories of one table."""
    if not part.table.num_rows:
        raise LogError("no rows", file=file, expected="at least one window of samples")
    times = part.layout.columns[0]
    data = values_in_si(part.table, part.layout, file, clock_start(part.table[times]))
    found = []
    for name, rows in _recordings(part, file.stem):
        require_increasing_times(data[rows, 0], rows, file, times)
        trajectory = made_trajectory(data[rows], part.layout, name=name, file=file)
        found.append(((name, f"{file.stem}/{name}", f"{file}/{name}"), trajectory))
    return found


def _recordings(part: LogTable, stem: str) -> list[tuple[str, np.ndarray]]:
    """Name and rows of each recording of a table, in order of their first rows."""
    if part.layout.labels is None:
        return [(part.recording or stem, np.arange(part.table.num_rows))]
    places: dict[str, int] = {}
    codes = [
        places.setdefault(str(label), len(places)) for label in part.table[part.layout.labels].to_pylist()
    ]
    order = np.argsort(codes, kind="stable")
    return list(zip(places, np.split(order, np.cumsum(np.bincount(codes))[:-1]), strict=True))


def _with_unique_names(labelled: Sequence[Named]) -> list[Trajectory]:
    for level in range(3):
        names = [labels[level] for labels, _ in labelled]
        if len(set(names)) == len(names):
            break
    return [replace(x, name=name) for name, (_, x) in zip(names, labelled, strict=True)]
