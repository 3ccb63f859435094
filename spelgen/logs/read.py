"""Read and write log files, in SI units and the URDF's senses: no filter, no resampling, no repair."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from spelgen.errors import LogError, collect
from spelgen.files import replacing
from spelgen.logs.arm_mapping import GivenMapping, LoggedArm, log_source
from spelgen.logs.formats import log_files, read_tables
from spelgen.logs.recording import in_time_order, make_trajectory
from spelgen.logs.tables import UNITS, UNITS_KEY, Layout
from spelgen.logs.trajectory import Trajectory, joined_column, require_joints
from spelgen.logs.tuning import TUNING
from spelgen.logs.values import clock_start, values_in_si


def read_logs(
    paths: Path | str | Iterable[Path | str],
    arm: LoggedArm,
    mapping: GivenMapping = None,
    role: str | None = None,
    *,
    joint_types: Sequence[str] | None = None,
) -> list[Trajectory]:
    """Return all trajectories of the given files and folders, in sorted order of their files.

    arm: one loaded from a URDF, a model, or the names of joints as the URDF has them; without a mapping, joint j
    has the columns `q_<j>`, `qd_<j>`, `tau_<j>`, beside the time `t` [s]. A column `trajectory` splits one file
    into several. mapping: how the logs are named and measured, as a LogMapping, its keys in a dict, or a YAML file
    of them; by default what the settings beside the arm's URDF say under `logs`. role "train" or "test": of a folder
    that contains train.* or test.* files, only those with this stem are read. joint_types: what the mapping's units are
    checked against, where `arm` is names alone.
    Raises LogError (or one error with several) naming file, row and column, and SettingsError where
    the mapping does not fit the joints.
    """
    source = log_source(arm, mapping)
    collect(source.mapping.misfits(source.joints, source.joint_types or joint_types))
    files, errors = log_files(paths, role)
    trajectories: list[Trajectory] = []
    for file in files:
        try:
            for layout, table in read_tables(file, source.joints, source.mapping):
                trajectories += _trajectories(layout, table)
        except LogError as error:  # all files are told of at once
            errors.append(error)
    collect(errors)
    return _with_unique_names(trajectories)


def write_logs(path: Path | str, trajectories: Sequence[Trajectory], arm: LoggedArm) -> Path:
    """Write one Parquet or CSV file (by suffix) with a `trajectory` column, all or nothing; return the path.

    arm: as for `read_logs`, which gives the same numbers back from either. Parquet files declare their units.
    Raises LogError for another suffix, without trajectories, and for those of another number of joints.
    """
    path, joints = Path(path), log_source(arm).joints
    if path.suffix not in (".parquet", ".csv"):
        raise LogError(f"a log named {path.name!r}", expected=".parquet or .csv")
    if not trajectories:
        raise LogError("no trajectory", file=path, expected="at least one")
    names: list[str] = []
    for trajectory in trajectories:
        require_joints(trajectory, joints)
        names += [trajectory.name] * len(trajectory)
    columns = {"trajectory": pa.array(names), "t": joined_column(trajectories, "t")}
    for quantity in trajectories[0].quantities:
        values = joined_column(trajectories, quantity)
        columns |= {f"{quantity}_{joint}": column for joint, column in zip(joints, values.T, strict=True)}
    # the file says that it is in SI units, so that no mapping is applied when it is read back
    table = pa.table(columns).replace_schema_metadata({UNITS_KEY: UNITS})
    with replacing(path) as unfinished:
        if path.suffix == ".csv":
            pa.csv.write_csv(table, unfinished)
        else:
            # as many rows together as a chunk of a log larger than memory has: a chunk then is one read
            pa.parquet.write_table(table, unfinished, row_group_size=TUNING.chunk_samples)
    return path


def _trajectories(layout: Layout, table: pa.Table) -> list[Trajectory]:
    """Return the trajectories of one table."""
    if not table.num_rows:
        raise LogError("no rows", file=layout.file, expected="at least one window of samples")
    data = values_in_si(table, layout, clock_start(table, layout))
    trajectories = []
    for name, rows in _recordings(layout, table):
        values, repairs = in_time_order(data[rows], rows, layout)
        trajectories.append(make_trajectory(values, layout, name, repairs))
    return trajectories


def _recordings(layout: Layout, table: pa.Table) -> list[tuple[str, np.ndarray]]:
    """Return name and rows of each recording of a table, in order of their first rows."""
    if layout.labels is None:
        return [(layout.recording or layout.file.stem, np.arange(table.num_rows))]
    # each label once: a name of a megabyte on a million rows is a small file
    labels = table[layout.labels].dictionary_encode("encode").combine_chunks()
    numbers = labels.indices.to_numpy()
    # sorting keeps time and memory in proportion to the rows, however many recordings there are
    rows = np.argsort(numbers, kind="stable")
    ends = np.cumsum(np.bincount(numbers))
    return list(zip(map(str, labels.dictionary.to_pylist()), np.split(rows, ends[:-1]), strict=True))


def _with_unique_names(trajectories: Sequence[Trajectory]) -> list[Trajectory]:
    """Return the trajectories under the shortest names that tell all of them apart."""
    names: list[str] = []
    for form in ("{0.name}", "{0.file.stem}/{0.name}", "{0.file}/{0.name}"):
        names = list(map(form.format, trajectories))
        if len(set(names)) == len(names):
            break
    return [replace(x, name=name) for x, name in zip(trajectories, names, strict=True)]
