"""Reader of NPZ archives, with an array per column, or matrices with a column per joint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pyarrow as pa

from spelgen.errors import LogError
from spelgen.logs.tables import LogFormat, LogTable, missing_columns, stored_columns, table_layout
from spelgen.logs.tuning import TUNING
from spelgen.settings.log_mapping import LogMapping

JOINT_NAMES = "joints"  # array with the names of the joints in the order of the columns of matrices
TRAJECTORY = "{trajectory}"


class NpzArrays:
    """Arrays of an NPZ archive, each read when it is first used, and never unpickled."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self._archive = ZipFile(file)
        self._members = {x.filename.removesuffix(".npy"): x for x in self._archive.infolist()}
        self.names = self._members.keys()
        self._arrays: dict[str, np.ndarray] = {}
        self._bytes = 0

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._arrays:
            member = self._members[name]
            # zipfile itself reads at most this size of a member
            self._bytes += member.file_size
            if self._bytes > TUNING.npz_bytes:
                raise LogError(
                    f"{self._bytes / 1e9:.3g} GB of arrays", file=self.file, element=f"array {member.filename}",
                    expected=f"at most {TUNING.npz_bytes / 1e9:.3g} GB", do="write larger logs as Parquet",
                )  # fmt: skip
            with self._archive.open(member) as data:
                try:
                    self._arrays[name] = np.lib.format.read_array(data, allow_pickle=False)
                except MemoryError:
                    raise ValueError(f"array {member.filename} is larger than the file says") from None
        return self._arrays[name]

    def column(self, name: str) -> pa.Array:
        """Return an array as a column; a matrix becomes a column of lists."""
        array = self[name]
        # Arrow rejects half and extended precision, and foreign byte orders
        wide = float if array.dtype.kind == "f" else array.dtype.newbyteorder("=")
        values = pa.array(array.astype(wide).ravel())
        return pa.FixedSizeListArray.from_arrays(values, array.shape[1]) if array.ndim == 2 else values


def read_npz(file: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """Return one table, or one per text in place of `{trajectory}` in the name of the times.

    Only the arrays of the mapping are read.
    """
    arrays, times = NpzArrays(file), mapping.columns.t
    if TRAJECTORY not in times:
        return [_table(None, arrays, joints, mapping)]
    tables = []
    for name in arrays.names:
        text = _trajectory_text(times, name)
        if text is not None:
            tables.append(_table(text, arrays, joints, mapping.of_trajectory(text)))
    if not tables:
        raise missing_columns([times], arrays.names, file, mapping, joints)
    return tables


def npz_columns(file: Path) -> pa.Table:
    """Return a table of all arrays that are as long as the longest one; matrices are columns of lists."""
    arrays = NpzArrays(file)
    lengths = {name: len(arrays[name]) for name in arrays.names if arrays[name].ndim in (1, 2)}
    samples = max(lengths.values(), default=0)
    return pa.table({name: arrays.column(name) for name, length in lengths.items() if length == samples})


def _trajectory_text(pattern: str, name: str) -> str | None:
    """Return the text in place of `{trajectory}` in a name, equal at all places; None if the pattern does not match.

    It is found by lengths, since regular expressions with several wildcards take exponential time on long names.
    """
    start = pattern.index(TRAJECTORY)
    length = (len(name) - len(pattern)) // pattern.count(TRAJECTORY) + len(TRAJECTORY)
    text = name[start : start + length]
    fits = length > 0 and pattern.replace(TRAJECTORY, text) == name
    return text if fits else None


def _table(recording: str | None, arrays: NpzArrays, joints: Sequence[str], mapping: LogMapping) -> LogTable:
    """Return the table of one recording of the archive, or of the only one."""
    for quantity in mapping.quantities:
        # a joint's column may belong to a matrix `q` (T, n)
        pattern: str = getattr(mapping.columns, quantity)
        matrix = pattern.replace("{joint}", "").rstrip("_")
        if matrix in arrays.names and arrays[matrix].ndim == 2:
            names = [mapping.log_name(joint) for joint in joints]
            places = dict(zip(names, _matrix_columns(arrays, matrix, names), strict=True))
            columns_of: dict[str, str] = {}
            for joint, name in zip(joints, names, strict=True):
                columns_of[joint] = mapping.column(quantity, joint)
                # a joint may have the column of another one
                for owner in (name, *names):
                    if pattern.replace("{joint}", owner) == columns_of[joint]:
                        columns_of[joint] = f"{matrix}[{places[owner]}]"
            mapping = mapping.with_joint_columns({joint: {quantity: x} for joint, x in columns_of.items()})
    # names only: the type of an array is unknown before it is read
    schema = pa.schema([(name, pa.null()) for name in arrays.names])
    layout = table_layout(schema, joints, mapping, arrays.file)
    if recording is not None:
        layout = replace(layout, labels=None, recording=recording)
    columns: dict[str, pa.Array] = {}
    samples = arrays[layout.columns[0]].shape
    for name in stored_columns(layout, arrays.names):
        shape = arrays[name].shape
        if shape[:1] != samples or len(shape) > 2 or (len(shape) == 2 and name in layout.columns):
            raise LogError(
                f"an array of shape {shape}", file=arrays.file, element=f"array {name}",
                expected=f"a value for each of the {samples[0] if samples else 0} times",
            )  # fmt: skip
        columns[name] = arrays.column(name)
    return layout, pa.table(columns)


def _matrix_columns(arrays: NpzArrays, matrix: str, joints: Sequence[str]) -> list[int]:
    """Return the columns of a matrix for the joints: by the array `joints`, else in the order of the arm's joints."""
    width = arrays[matrix].shape[1]
    if JOINT_NAMES not in arrays.names:
        if width != len(joints):
            raise LogError(
                f"{width} columns", file=arrays.file, element=f"array {matrix}",
                expected=f"{len(joints)}, one for each joint", do=f"name them by an array {JOINT_NAMES!r}",
            )  # fmt: skip
        return list(range(width))
    names = list(map(str, arrays[JOINT_NAMES].ravel()))
    for joint in joints:
        if joint not in names or len(names) != width:
            raise LogError(
                f"the joints {', '.join(names)}", file=arrays.file, element=f"array {JOINT_NAMES}",
                expected=f"{joint} among the names of the {width} columns of {matrix}",
            )  # fmt: skip
    return list(map(names.index, joints))


NPZ = LogFormat(read_npz, suffixes=(".npz",), columns=npz_columns)
