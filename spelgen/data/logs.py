"""Log files <-> trajectories, exactly as recorded: no filtering, no resampling, no repair."""

from __future__ import annotations

import difflib
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from spelgen.errors import LogError, SpelgenError, collect

SUFFIXES = (".parquet", ".csv")
QUANTITIES = ("q", "qd", "tau")
UNITS_KEY = b"units"
UNITS = b"t s, q rad or m, qd rad/s or m/s, tau Nm or N"


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One uninterrupted recording of an arm with n joints.

    name: unique among the trajectories read together.
    t: (T,) sample times [s], strictly increasing, not necessarily regular.
    q, qd: (T, n) joint positions and velocities [rad, rad/s; m, m/s for prismatic joints].
    tau: (T, n) joint torques or forces [Nm; N]. In a simulated log tau[k] is held from t[k] to t[k+1]; in a
        measured one it is the torque measured at t[k].
    file: where it was read from, None if it was not.
    declares_units: the file itself says that its columns are in the units above.
    """

    name: str
    t: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    tau: np.ndarray
    file: Path | None = None
    declares_units: bool = False

    def __post_init__(self) -> None:
        samples = self.t.shape[0] if self.t.ndim == 1 else -1
        for name in QUANTITIES:
            array = getattr(self, name)
            if array.ndim != 2 or array.shape[0] != samples or array.shape != self.q.shape:
                raise ValueError(
                    f"trajectory {self.name}: {name} has shape {array.shape} beside t of shape {self.t.shape}"
                )

    def __getitem__(self, rows: slice) -> Trajectory:
        """The same recording, only these rows."""
        cut = {name: getattr(self, name)[rows] for name in ("t", *QUANTITIES)}
        return Trajectory(self.name, **cut, file=self.file, declares_units=self.declares_units)


def read_logs(
    paths: Iterable[Path | str], joints: Sequence[str], *, role: str | None = None
) -> list[Trajectory]:
    """All trajectories of the given files and folders, in sorted order of their files.

    joints: the URDF's joint names; joint j has the columns `q_<j>`, `qd_<j>`, `tau_<j>`, beside the time `t`
    [s]. A column `trajectory` splits one file into several. role "train" or "test": of a folder that holds
    train.* or test.* files, only those with this stem are read.
    Raises LogError (or one error that holds several) naming file, row and column.
    """
    errors: list[SpelgenError] = []
    labelled: list[tuple[tuple[str, str, str], Trajectory]] = []
    for file in _log_files(paths, role, errors):
        try:
            labelled += _read_file(file, tuple(joints))
        except LogError as error:
            errors.append(error)
    collect(errors)
    return _with_unique_names(labelled)


def write_logs(path: Path | str, trajectories: Sequence[Trajectory], joints: Sequence[str]) -> None:
    """Write one Parquet or CSV file (by suffix) with a `trajectory` column, all or nothing.

    `read_logs` gives the same numbers back from either. Parquet files declare their units.
    """
    path = Path(path)
    write = _writer(path)
    columns: dict[str, np.ndarray | list[str]] = {
        "trajectory": [x.name for x in trajectories for _ in x.t],
        "t": np.concatenate([x.t for x in trajectories]),
    }
    for quantity in QUANTITIES:
        values = np.concatenate([getattr(x, quantity) for x in trajectories])
        columns |= {f"{quantity}_{joint}": values[:, i] for i, joint in enumerate(joints)}
    table = pa.table(columns).replace_schema_metadata({UNITS_KEY: UNITS})
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(path.name + ".tmp")
    write(table, unfinished)
    os.replace(unfinished, path)


def _writer(path: Path) -> Callable[[pa.Table, Path], None]:
    writers = {".parquet": pa.parquet.write_table, ".csv": pa.csv.write_csv}
    if path.suffix not in writers:
        raise LogError(f"a log named {path.name!r}", expected=" or ".join(SUFFIXES))
    return writers[path.suffix]


def _log_files(paths: Iterable[Path | str], role: str | None, errors: list[SpelgenError]) -> list[Path]:
    files: dict[Path, None] = {}
    for path in map(Path, paths):
        if path.is_dir():
            found = _folder_files(path, role)
            if not found:
                wanted = f"{role}.parquet or {role}.csv" if role else "*.parquet or *.csv"
                errors.append(LogError("a folder without such logs", file=path, expected=wanted))
            files |= dict.fromkeys(found)
        elif not path.exists():
            errors.append(
                LogError("no such file or folder", file=path, expected="a log", do="check the path")
            )
        elif path.suffix not in SUFFIXES:
            errors.append(
                LogError(f"a file of kind {path.suffix!r}", file=path, expected=" or ".join(SUFFIXES))
            )
        else:
            files[path] = None
    return list(files)


def _folder_files(folder: Path, role: str | None) -> list[Path]:
    found = sorted(path for path in folder.iterdir() if path.suffix in SUFFIXES)
    if role and any(path.stem in ("train", "test") for path in found):
        return [path for path in found if path.stem == role]
    return found


def _read_file(file: Path, joints: tuple[str, ...]) -> list[tuple[tuple[str, str, str], Trajectory]]:
    """The file's trajectories, each with its possible names from the shortest to the surely unique."""
    table = _read_table(file)
    wanted = ["t", *(f"{quantity}_{joint}" for quantity in QUANTITIES for joint in joints)]
    _require_columns(table, wanted, file)
    data = np.stack([_numbers(table, column, file) for column in wanted], axis=1)  # (T, 1 + 3n)
    _require_finite(data, wanted, file)
    declared = UNITS_KEY in (table.schema.metadata or {})
    labels = (
        np.array(table["trajectory"].to_pylist(), dtype=str) if "trajectory" in table.column_names else None
    )
    names = [file.stem] if labels is None else list(dict.fromkeys(labels.tolist()))
    found = []
    for name in names:
        rows = np.arange(len(data)) if labels is None else np.flatnonzero(labels == name)
        _require_increasing_times(data[rows, 0], rows, file)
        q, qd, tau = np.split(data[rows, 1:], 3, axis=1)
        trajectory = Trajectory(name, data[rows, 0], q, qd, tau, file=file, declares_units=declared)
        found.append(((name, f"{file.stem}/{name}", f"{file}/{name}"), trajectory))
    return found


def _read_table(file: Path) -> pa.Table:
    reader = pa.parquet.read_table if file.suffix == ".parquet" else pa.csv.read_csv
    try:
        table = reader(file)
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        reason = str(error).splitlines()[0].rstrip(".")
        raise LogError(f"an unreadable {file.suffix[1:]} file ({reason})", file=file) from error
    if table.num_rows == 0:
        raise LogError("no rows", file=file, expected="at least one window of samples")
    return table


def _require_columns(table: pa.Table, wanted: Sequence[str], file: Path) -> None:
    present = table.column_names
    repeated = sorted({name for name in wanted if present.count(name) > 1})
    if repeated:
        raise LogError(
            "the same column twice", file=file, element=f"column {', '.join(repeated)}", expected="it once"
        )
    missing = [name for name in wanted if name not in present]
    if missing:
        close = difflib.get_close_matches(missing[0], present, n=1)
        advice = (
            f"rename the column {close[0]!r} to {missing[0]!r}?" if close else "add or rename the columns"
        )
        what = f"column {missing[0]}" if len(missing) == 1 else f"columns {', '.join(missing)}"
        there = f"only the columns {', '.join(present)}"
        raise LogError(
            there,
            file=file,
            element=f"missing {what}",
            expected="t, q_<joint>, qd_<joint>, tau_<joint>",
            do=advice,
        )


def _numbers(table: pa.Table, column: str, file: Path) -> np.ndarray:
    try:
        return table[column].cast(pa.float64()).to_numpy()
    except (pa.ArrowException, ValueError) as error:
        kind = table.schema.field(column).type
        raise LogError(
            f"values of type {kind}", file=file, element=f"column {column}", expected="numbers"
        ) from error


def _require_finite(data: np.ndarray, columns: Sequence[str], file: Path) -> None:
    bad = ~np.isfinite(data)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        count = int(bad.any(axis=1).sum())
        raise LogError(
            f"no finite number ({count} of {len(data)} rows have such a gap, this is the first)",
            file=file, line=_line(file, row), element=f"row {row + 1}, column {columns[column]}",
            expected="a number", do="remove those rows; a gap in t is understood",
        )  # fmt: skip


def _require_increasing_times(t: np.ndarray, rows: np.ndarray, file: Path) -> None:
    back = np.flatnonzero(np.diff(t) <= 0)
    if back.size:
        k = int(back[0])
        raise LogError(
            f"t = {t[k + 1]:g} s after {t[k]:g} s ({back.size} such steps, this is the first)",
            file=file, line=_line(file, rows[k + 1]), element=f"row {rows[k + 1] + 1}, column t",
            expected="increasing times",
            do="sort the rows, drop repeats, or split recordings by a column 'trajectory'",
        )  # fmt: skip


def _line(file: Path, row: int) -> int | None:
    """The line of a 0-based data row, where the format has lines (a CSV's first is its header)."""
    return int(row) + 2 if file.suffix == ".csv" else None


def _with_unique_names(labelled: Sequence[tuple[tuple[str, str, str], Trajectory]]) -> list[Trajectory]:
    for level in range(3):
        names = [labels[level] for labels, _ in labelled]
        if len(set(names)) == len(names):
            break
    return [
        Trajectory(name, x.t, x.q, x.qd, x.tau, file=x.file, declares_units=x.declares_units)
        for name, (_, x) in zip(names, labelled, strict=True)
    ]
