"""Reader of NPZ archives that contain one array per column, or matrices with one column per joint."""

from collections.abc import Collection, Sequence
from itertools import starmap
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pyarrow as pa

from spelgen.errors import LogError
from spelgen.logs.tables import LogTable, missing_columns
from spelgen.logs.tuning import TUNING
from spelgen.settings.log_mapping import LogMapping

JOINT_NAMES = "joints"  # name of an optional array with the names of the joints in the columns of matrices
TRAJECTORY = "{trajectory}"


class NpzArrays:
    """Arrays of an NPZ archive. An array is read when it is first used; pickled objects are rejected."""

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
            # The stated size bounds the memory even if it is wrong, since zipfile does not read more bytes of an array.
            self._bytes += member.file_size
            if self._bytes > TUNING.npz_bytes:
                got, expected = (
                    f"{self._bytes / 1e9:.3g} GB of arrays",
                    f"at most {TUNING.npz_bytes / 1e9:.3g} GB",
                )
                raise self.error(member.filename, got, expected, "write larger logs as Parquet")
            with self._archive.open(member) as data:
                try:
                    self._arrays[name] = np.lib.format.read_array(data, allow_pickle=False)
                except ValueError as error:
                    if "allow_pickle" not in str(error):
                        raise
                    do = f"store numbers, for example by numpy.savez(FILE, {name}=numpy.stack(LIST))"
                    raise self.error(name, "Python objects", "numbers", do) from error
                except MemoryError:
                    raise ValueError(f"array {member.filename} is larger than the file says") from None
        return self._arrays[name]

    def error(self, name: str, got: str, expected: str, do: str | None = None) -> LogError:
        """Return an error about the array of this name."""
        return LogError(got, file=self.file, element=f"array {name}", expected=expected, do=do)

    def is_vector(self, name: str) -> bool:
        """Return True for an array (T,), (T, 1) or (1, T): MATLAB stores vectors as matrices."""
        return max(self[name].shape, default=0) == self[name].size

    def column(self, name: str, *, is_list: bool) -> pa.Array:
        """Return the array of this name as a column of a table. is_list: the rows of a matrix become lists."""
        array = self[name]
        # The array is converted to double precision and native byte order, since Arrow rejects other types and byte
        # orders.
        wide = float if array.dtype.kind == "f" else array.dtype.newbyteorder("=")
        values = pa.array(array.astype(wide).ravel())
        return pa.FixedSizeListArray.from_arrays(values, array.shape[1]) if is_list else values


def read_npz(file: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """Return one table per recording; only the arrays that the mapping names are read.

    If the mapping's name of the times contains `{trajectory}`, the archive contains several recordings: with
    "t_{trajectory}", the arrays "t_a" and "t_b" are the times of the recordings "a" and "b".
    """
    arrays, times = NpzArrays(file), mapping.columns.t
    if TRAJECTORY not in times:
        return [_table(None, arrays, joints, mapping)]
    texts = [text for text in (_trajectory_text(times, name) for name in arrays.names) if text is not None]
    if not texts:
        raise missing_columns([times], arrays.names, file, mapping, joints)
    return [_table(text, arrays, joints, mapping.of_trajectory(text)) for text in texts]


def _trajectory_text(pattern: str, name: str) -> str | None:
    """Return the text that an array's name has in place of `{trajectory}`; None if the name does not match the pattern.

    A pattern may contain `{trajectory}` several times, for the same text. The length of the text is computed from the
    length of the name. A regular expression with several wildcards could take exponential time on long names.
    """
    start = pattern.index(TRAJECTORY)
    length = (len(name) - len(pattern)) // pattern.count(TRAJECTORY) + len(TRAJECTORY)
    text = name[start : start + length]
    fits = length > 0 and pattern.replace(TRAJECTORY, text) == name
    return text if fits else None


def _table(recording: str | None, arrays: NpzArrays, joints: Sequence[str], mapping: LogMapping) -> LogTable:
    """Return the table of one recording of the archive; `recording` is its name, None if it is the only one."""
    for quantity in mapping.quantities if joints else ():
        mapping = _with_matrix_columns(quantity, arrays, joints, mapping)
    # The mapping names an array as a whole, or the columns of a matrix, such as q[0].
    whole = {mapping.columns.t, *starmap(mapping.column, mapping.signals(joints))}

    def read(names: list[str] | None) -> pa.Table:
        return _longest(arrays) if names is None else _equally_long(arrays, names, whole)

    # the schema has names without types, since the type of an array is known only after reading it
    schema = pa.schema([(name, pa.null()) for name in arrays.names])
    return LogTable(schema, read, mapping, recording=recording)


def _equally_long(arrays: NpzArrays, names: Sequence[str], whole: Collection[str]) -> pa.Table:
    """Return a table of arrays; matrices (T, n) become columns of lists. Raises LogError if lengths differ.

    whole: names of arrays that are vectors, also if they have the shape (T, 1) or (1, T).
    """
    columns: dict[str, pa.Array] = {}
    samples = None
    for name in names:
        array, is_list = arrays[name], name not in whole and arrays[name].ndim == 2
        length = len(array) if is_list else array.size
        samples = length if samples is None else samples
        if length != samples or not (is_list or arrays.is_vector(name)):
            expected, do = f"a value for each of the {samples} times", "resample it to these times"
            raise arrays.error(name, f"an array of shape {array.shape}", expected, do)
        columns[name] = arrays.column(name, is_list=is_list)
    return pa.table(columns)


def _longest(arrays: NpzArrays) -> pa.Table:
    """Return a table of the arrays with as many rows as the longest one; matrices (T, n) become columns of lists."""
    names = [name for name in arrays.names if arrays[name].ndim in (1, 2)]
    vectors = set(filter(arrays.is_vector, names))
    rows = {name: arrays[name].size if name in vectors else len(arrays[name]) for name in names}
    samples = max(rows.values(), default=0)
    return _equally_long(arrays, [name for name in names if rows[name] == samples], vectors)


def _with_matrix_columns(
    quantity: str, arrays: NpzArrays, joints: Sequence[str], mapping: LogMapping
) -> LogMapping:
    """Return the mapping with columns such as `q[0]` for a quantity that is stored as a matrix (T, n).

    If the archive contains no such matrix, the mapping is returned unchanged.
    """
    pattern = mapping.pattern(quantity)
    matrix = pattern.replace("{joint}", "").rstrip("_")
    if matrix not in arrays.names or arrays[matrix].ndim < 2:
        return mapping
    if arrays[matrix].ndim > 2:
        got, expected = f"an array of shape {arrays[matrix].shape}", "a row per time and a column per joint"
        raise arrays.error(matrix, got, expected, "store an array per recording, such as q_1, q_2")
    names = [mapping.log_name(joint) for joint in joints]
    column_of = dict(zip(names, _matrix_columns(arrays, matrix, names), strict=True))
    columns: dict[str, dict[str, str | None]] = {}
    for joint, name in zip(joints, names, strict=True):
        column = mapping.column(quantity, joint)
        # The mapping may assign the column of another joint to this joint; owners[0] is the joint whose column it is.
        owners = [x for x in (name, *names) if pattern.replace("{joint}", x) == column]
        columns[joint] = {quantity: f"{matrix}[{column_of[owners[0]]}]" if owners else column}
    return mapping.with_joint_columns(columns)


def _matrix_columns(arrays: NpzArrays, matrix: str, joints: Sequence[str]) -> list[int]:
    """Return the index of each joint's column in a matrix.

    The array `joints` of the archive states the order of the columns; without it the order is the arm's.
    """
    width = arrays[matrix].shape[1]
    if JOINT_NAMES not in arrays.names:
        if width != len(joints):
            expected, do = f"{len(joints)}, one for each joint", f"name them by an array {JOINT_NAMES!r}"
            if len(arrays[matrix]) == len(joints):
                do = "transpose it: rows are times"
            raise arrays.error(matrix, f"{width} columns", expected, do)
        return list(range(width))
    names = list(map(str, arrays[JOINT_NAMES].ravel()))
    for joint in joints:
        if joint not in names or len(names) != width:
            expected = f"{joint} among the names of the {width} columns of {matrix}"
            raise arrays.error(JOINT_NAMES, f"the joints {', '.join(names)}", expected)
    return list(map(names.index, joints))
