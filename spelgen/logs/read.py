"""Reading and writing of log files, in SI units and with the URDF's signs, without filtering or resampling."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from spelgen.errors import Diagnostic, LogError, collect
from spelgen.files import replacing
from spelgen.logs.arm_mapping import GivenMapping, LoggedArm, LogSource, log_source
from spelgen.logs.formats import LogPaths, log_files, read_tables
from spelgen.logs.segments import LogSegments
from spelgen.logs.tables import UNITS, UNITS_KEY
from spelgen.logs.trajectory import Trajectory, joined_column, recordings
from spelgen.logs.tuning import TUNING


def read_logs(
    paths: LogPaths,
    arm: LoggedArm,
    mapping: GivenMapping = None,
    role: str | None = None,
    *,
    joint_types: Sequence[str] | None = None,
) -> list[Trajectory]:
    """Return all trajectories of the given files and folders; the files of a folder are read in alphabetical order.

    Without a mapping, a log has a column `t` with times [s] and, for each joint j, the columns `q_<j>`, `qd_<j>` and
    `tau_<j>`. A column `trajectory` divides a file into several trajectories.

    Args:
        paths: files and folders of logs.
        arm: result of `load_arm`, a model, or the names of the joints in the URDF.
        mapping: columns and units of the logs, as a LogMapping, a dict of its keys, or a YAML file; None: the group
            `logs` of the arm's settings.
        role: "train" or "test". If a folder contains files train.* or test.*, only the files named after the role are
            read. None: all files are read.
        joint_types: "revolute" or "prismatic" per joint, for the check of the mapping's units if `arm` is a list of
            names.

    Raises:
        LogError: with file, row and column of a fault; several faults are raised as one error.
        SettingsError: for a mapping that does not fit the joints.
    """
    return _read(paths, log_source(arm, mapping), role, LogSegments(), joint_types)


class BoundedLogs(NamedTuple):
    """Trajectories within a limit of memory, and a note with the number of kept samples; no note if all were kept."""

    trajectories: list[Trajectory]
    notes: list[Diagnostic]


def read_bounded_logs(
    paths: LogPaths, arm: LoggedArm, mapping: GivenMapping = None, role: str | None = None
) -> BoundedLogs:
    """Return the logs like `read_logs`, reduced to evenly spread segments if they exceed `LogTuning.kept_bytes`.

    Files are read and reduced one at a time, so that only the largest file and the kept samples need to fit into
    memory. A reduced recording has gaps between its segments. The selection is deterministic. Raises the errors of
    `read_logs`; faults of rows that are not kept are not detected.
    """
    segments = LogSegments(TUNING.kept_bytes)
    trajectories = _read(paths, log_source(arm, mapping), role, segments)
    notes = []
    if segments.every > 1:
        message = (
            f"{segments.rows} samples are more than {TUNING.kept_bytes / 1e6:.0f} MB of numbers: one of "
            f"{segments.every} segments of up to {TUNING.segment_samples} samples was kept, "
            f"{sum(map(len, trajectories))} samples; gaps between segments are not gaps of the files"
        )
        notes.append(Diagnostic("info", "subsampled", "logs", None, message))
    return BoundedLogs(trajectories, notes)


def _read(
    paths: LogPaths,
    source: LogSource,
    role: str | None,
    segments: LogSegments,
    joint_types: Sequence[str] | None = None,
) -> list[Trajectory]:
    """Return the trajectories of all files, from the rows that `segments` keeps: all, or a part within a memory limit.

    If files have faults, one LogError with the first error of each file is raised.

    Args:
        paths, role: see `read_logs`.
        source: joints of the logs, and the mapping of their columns.
        segments: empty collector of the rows of the files, made with the memory limit.
        joint_types: types of the joints, for the check of the units in the mapping.
    """
    collect(source.mapping.misfits(source.joints, source.joint_types or joint_types))
    files, errors = log_files(paths, role)
    for file in files:
        try:
            for layout, table in read_tables(file, source.joints, source.mapping):
                segments.add(layout, table)
                del table  # The memory of a table is freed before the next one is read.
        except LogError as error:
            errors.append(error)
    trajectories = []
    for recording in segments.trajectories():
        if isinstance(recording, Trajectory):
            trajectories.append(recording)
        elif recording.file not in {error.file for error in errors}:
            errors.append(recording)
    collect(errors)
    return _with_unique_names(trajectories)


def write_logs(path: Path | str, trajectories: Sequence[Trajectory], arm: LoggedArm) -> Path:
    """Write trajectories to one Parquet or CSV file, as the suffix of the path states; return the path.

    If an error occurs, no incomplete file remains. The column `trajectory` contains the names of the trajectories.
    `read_logs` returns the same numbers from both formats. arm: result of `load_arm`, a model, or the names of the
    joints. Raises LogError for another suffix, if there are no trajectories, and for trajectories whose number of
    joints differs from the arm.
    """
    path, joints = Path(path), log_source(arm).joints
    if path.suffix not in (".parquet", ".csv"):
        raise LogError(f"a log named {path.name!r}", expected=".parquet or .csv")
    trajectories = recordings(trajectories, joints)
    names = [x.name for x in trajectories for _ in range(len(x))]
    columns = {"trajectory": pa.array(names), "t": joined_column(trajectories, "t")}
    for quantity in trajectories[0].quantities:
        values = joined_column(trajectories, quantity)
        columns |= {f"{quantity}_{joint}": column for joint, column in zip(joints, values.T, strict=True)}
    # The metadata of a Parquet file declare SI units, so that no mapping is applied when the file is read.
    table = pa.table(columns).replace_schema_metadata({UNITS_KEY: UNITS})
    with replacing(path) as unfinished:
        if path.suffix == ".csv":
            pa.csv.write_csv(table, unfinished)
        else:
            pa.parquet.write_table(table, unfinished, row_group_size=2**16)
    return path


def _with_unique_names(trajectories: Sequence[Trajectory]) -> list[Trajectory]:
    """Return the trajectories with unique names.

    If names occur more than once, all names are preceded by the stems or paths of their files.
    """
    names: list[str] = []
    # The shortest form of names that is unique is used, since names occur in tables and messages.
    for form in ("{0.name}", "{0.file.stem}/{0.name}", "{0.file}/{0.name}"):
        names = list(map(form.format, trajectories))
        if len(set(names)) == len(names):
            break
    return [replace(x, name=name) for x, name in zip(trajectories, names, strict=True)]
