"""Read NPZ archives: an array for each column, or matrices with a column for each joint."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from spelgen.errors import LogError
from spelgen.logs.tables import (
    LogFormat,
    LogTable,
    missing_columns,
    reading,
    stored_columns,
    table_layout,
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
    with reading(file):
        columns = {name: _arrow_column(array) for name, array in arrays.items() if len(array) == samples}
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
    recording: str | None, arrays: NpzArrays, file: Path, joints: Sequence[str], mapping: LogMapping
) -> LogTable:
    """Return the table of one recording of the archive, or of the only one."""
    mapping = _with_matrices(arrays, file, joints, mapping)
    # names alone: to learn an array's type is to read it
    schema = pa.schema([(name, pa.null()) for name in arrays])
    layout = table_layout(schema, joints, mapping, file)
    if recording is not None:
        layout = replace(layout, labels=None)
    columns: dict[str, pa.Array] = {}
    samples = arrays[layout.columns[0]].shape
    for name in stored_columns(layout, schema.names):
        array = arrays[name]
        if array.shape[:1] != samples or array.ndim > 2 or (array.ndim == 2 and name in layout.columns):
            raise LogError(
                f"an array of shape {array.shape}", file=file, element=f"array {name}",
                expected=f"a value for each of the {samples[0] if samples else 0} times",
            )  # fmt: skip
        with reading(file):
            columns[name] = _arrow_column(array)
    return LogTable(recording, pa.table(columns), layout)


def _with_matrices(arrays: NpzArrays, file: Path, joints: Sequence[str], mapping: LogMapping) -> LogMapping:
    """Return the mapping in which a joint's column is that of a matrix `q` (T, n), where the archive has one."""
    for quantity in mapping.quantities:
        pattern: str = getattr(mapping.columns, quantity)
        matrix = pattern.replace("{joint}", "").rstrip("_")
        if matrix not in arrays or arrays[matrix].ndim != 2:
            continue
        names = [mapping.log_name(joint) for joint in joints]
        for joint, column in zip(joints, _matrix_columns(arrays, matrix, names, file), strict=True):
            mapping = mapping.with_joint_columns({joint: {quantity: f"{matrix}[{column}]"}})
    return mapping


def _matrix_columns(arrays: NpzArrays, matrix: str, joints: Sequence[str], file: Path) -> list[int]:
    """Return the joints' columns of a matrix: as the array `joints` says, else in the order of the arm's joints."""
    width = arrays[matrix].shape[1]
    if JOINT_NAMES not in arrays:
        if width != len(joints):
            raise LogError(
                f"{width} columns", file=file, element=f"array {matrix}",
                expected=f"{len(joints)}, one for each joint", do=f"name them by an array {JOINT_NAMES!r}",
            )  # fmt: skip
        return list(range(width))
    names = list(map(str, arrays[JOINT_NAMES].ravel()))
    for joint in joints:
        if joint not in names or len(names) != width:
            raise LogError(
                f"the joints {', '.join(names)}", file=file, element=f"array {JOINT_NAMES}",
                expected=f"{joint} among the names of the {width} columns of {matrix}",
            )  # fmt: skip
    return [names.index(joint) for joint in joints]


def _arrow_column(array: np.ndarray) -> pa.Array:
    """Return an array as a column, of a matrix a column of its rows."""
    # Arrow refuses half and extended precision, and the other byte order
    wide = float if array.dtype.kind == "f" else array.dtype.newbyteorder("=")
    values = pa.array(array.astype(wide).ravel())
    return pa.FixedSizeListArray.from_arrays(values, array.shape[1]) if array.ndim == 2 else values


NPZ = LogFormat(read_npz, suffixes=(".npz",), columns=npz_columns)
