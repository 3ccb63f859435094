"""Read NPZ archives: an array for each column, or matrices with a column for each joint."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

from spelgen.errors import LogError
from spelgen.logs.tables import (
    LogFormat,
    LogTable,
    list_element,
    make_layout,
    missing_columns,
    reading,
    wanted_quantities,
)
from spelgen.settings.log_mapping import LogMapping
from spelgen.settings.tuning.logs import LogTuning

TUNING = LogTuning()
JOINT_NAMES = "joints"  # the array of joint names, by the columns of the matrices
TRAJECTORY = "{trajectory}"


class NpzArrays(Mapping[str, np.ndarray]):
    """Hold the arrays of an NPZ archive, each read when it is first asked for, and never unpickled."""

    def __init__(self, file: Path, archive: zipfile.ZipFile) -> None:
        self._file, self._archive = file, archive
        self._members = {x.filename.removesuffix(".npy"): x for x in archive.infolist()}
        self._arrays: dict[str, np.ndarray] = {}
        self._bytes = 0

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._arrays:
            self._arrays[name] = self._read(self._members[name])
        return self._arrays[name]

    def __contains__(self, name: object) -> bool:
        return name in self._members  # a mapping's own would read the array

    def __iter__(self) -> Iterator[str]:
        return iter(self._members)

    def __len__(self) -> int:
        return len(self._members)

    def _read(self, member: zipfile.ZipInfo) -> np.ndarray:
        # zipfile itself reads no more of a member than this size says
        self._bytes += member.file_size
        if self._bytes > TUNING.npz_bytes:
            raise LogError(
                f"{self._bytes / 1e9:.3g} GB of arrays", file=self._file, element=f"array {member.filename}",
                expected=f"at most {TUNING.npz_bytes / 1e9:.3g} GB", do="write larger logs as Parquet",
            )  # fmt: skip
        with reading(self._file), self._archive.open(member) as data:
            try:
                return np.lib.format.read_array(data, allow_pickle=False)
            except MemoryError:
                raise ValueError(f"array {member.filename} is larger than the file says") from None


def read_npz(file: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """Return one recording, or one for each text that `{trajectory}` stands for in the name of the times.

    Arrays that are not asked for are not looked at.
    """
    with _opened(file) as archive:
        arrays = NpzArrays(file, archive)
        if TRAJECTORY not in mapping.columns.t:
            return [_table(None, arrays, file, joints, mapping)]
        tables = []
        for name in arrays:
            text = _trajectory_text(mapping.columns.t, name)
            if text is not None:
                tables.append(_table(text, arrays, file, joints, mapping.of_trajectory(text)))
        if not tables:
            raise missing_columns([mapping.columns.t], list(arrays), file, mapping, joints)
        return tables


def npz_columns(file: Path) -> pa.Table:
    """Return all arrays with as many values, or rows, as the longest has; matrices as lists."""
    arrays: dict[str, np.ndarray] = {}
    with _opened(file) as archive:
        for name, array in NpzArrays(file, archive).items():
            if array.ndim in (1, 2):
                arrays[name] = array
    samples = max(map(len, arrays.values()), default=0)
    columns: dict[str, np.ndarray | list[object]] = {}
    with reading(file):
        for name, array in arrays.items():
            if len(array) == samples:
                values = _arrow_compatible(array)
                columns[name] = values.tolist() if values.ndim == 2 else values
        return pa.table(columns)


def _opened(file: Path) -> zipfile.ZipFile:
    with reading(file):
        return zipfile.ZipFile(file)


def _trajectory_text(pattern: str, name: str) -> str | None:
    """Return what stands for `{trajectory}` in a name, everywhere the same; None where the pattern does not fit.

    By lengths: a regular expression with several open ends takes exponential time on a long name.
    """
    prefix = pattern.partition(TRAJECTORY)[0]
    count = pattern.count(TRAJECTORY)
    length = (len(name) - len(pattern)) // count + len(TRAJECTORY)
    text = name[len(prefix) : len(prefix) + length]
    fits = length > 0 and pattern.replace(TRAJECTORY, text) == name
    return text if fits else None


def _table(
    text: str | None, arrays: NpzArrays, file: Path, joints: Sequence[str], mapping: LogMapping
) -> LogTable:
    """Return the table of one recording, whose name is the text."""
    times, labels = mapping.columns.t, mapping.columns.trajectory
    names = [times]
    columns: dict[str, np.ndarray] = {}
    if times in arrays:
        columns[times] = arrays[times]
    for quantity in wanted_quantities(mapping):
        for index in range(len(joints)):
            name, values = _joint_column(arrays, quantity, index, joints, mapping, file)
            names.append(name)
            if values is not None:
                columns[name] = values
    missing = [name for name in names if name not in columns]
    if missing:
        raise missing_columns(missing, list(arrays), file, mapping, joints)
    _require_samples(columns, file)
    has_labels = text is None and labels in arrays
    if has_labels:
        columns[labels] = arrays[labels]
    with reading(file):
        table = pa.table({name: _arrow_compatible(array) for name, array in columns.items()})
    return LogTable(text, table, make_layout(names, labels if has_labels else None, joints, mapping))


def _joint_column(
    arrays: NpzArrays, quantity: str, index: int, joints: Sequence[str], mapping: LogMapping, file: Path
) -> tuple[str, np.ndarray | None]:
    """Return name and values (T,) of a joint's column: of a matrix `q` (T, n), else an array of its own."""
    name = mapping.column(quantity, joints[index])
    pattern: str = getattr(mapping.columns, quantity)
    matrix = pattern.replace("{joint}", "").rstrip("_")
    if matrix in arrays and arrays[matrix].ndim == 2:
        column = _matrix_column(arrays, index, mapping.log_name(joints[index]), matrix, len(joints), file)
        return f"{matrix}[:, {column}]", arrays[matrix][:, column]
    if name in arrays:
        return name, arrays[name]
    element = list_element(name, list(arrays))
    if element is not None:
        array = arrays[element[0]]
        if array.ndim == 2 and element[1] < array.shape[1]:
            return name, array[:, element[1]]
    return name, None


def _arrow_compatible(array: np.ndarray) -> np.ndarray:
    """Return the array in a type that Arrow knows: this machine's byte order, at most double precision."""
    # Arrow refuses half and extended precision, and the other byte order
    if array.dtype.kind == "f":
        return array.astype(float)
    return array.astype(array.dtype.newbyteorder("="))


def _matrix_column(arrays: NpzArrays, index: int, name: str, matrix: str, joints: int, file: Path) -> int:
    """Return a joint's column of a matrix: as the array `joints` says, else in the order of the arm's joints."""
    width = arrays[matrix].shape[1]
    if JOINT_NAMES not in arrays:
        if width != joints:
            raise LogError(
                f"{width} columns", file=file, element=f"array {matrix}",
                expected=f"{joints}, one for each joint", do=f"name them by an array {JOINT_NAMES!r}",
            )  # fmt: skip
        return index
    names = [str(x) for x in arrays[JOINT_NAMES].ravel()]
    if name not in names or len(names) != width:
        raise LogError(
            f"the joints {', '.join(names)}", file=file, element=f"array {JOINT_NAMES}",
            expected=f"{name} among the names of the {width} columns of {matrix}",
        )  # fmt: skip
    return names.index(name)


def _require_samples(columns: Mapping[str, np.ndarray], file: Path) -> None:
    """Raise LogError unless all columns have the shape of the first, which are the times."""
    times = next(iter(columns.values()))
    for name, array in columns.items():
        if array.ndim != 1 or array.shape != times.shape:
            raise LogError(
                f"an array of shape {array.shape}", file=file, element=f"array {name}",
                expected=f"a value for each of the {times.shape[0] if times.shape else 0} times",
            )  # fmt: skip


NPZ = LogFormat(read_npz, suffixes=(".npz",), columns=npz_columns)
