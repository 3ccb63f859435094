"""Reader of NPZ archives that contain one array per column, or matrices with one column per joint."""

import json
import re
from collections.abc import Collection, Mapping, Sequence
from itertools import islice, starmap
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pyarrow as pa

from spelgen.errors import LogError, collect
from spelgen.logs.tables import JOINTS_KEY, LogTable, missing_columns
from spelgen.logs.tuning import TUNING
from spelgen.settings.log_mapping import LogMapping

# Names of the optional array with the joints' names, in the order of matrix columns, such as `joints`, `joint_names`.
JOINT_NAMES = re.compile(r"(joint|dof|motor|actuator)(s|_?names?)", re.IGNORECASE)
TRAJECTORY = "{trajectory}"


class NpzArrays:
    """Arrays of an NPZ archive by name. An array is read when it is first used; pickled objects are rejected."""

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
            # The memory is bounded by the sizes that the archive states for its arrays. An archive that states too
            # small a size is no risk, since zipfile reads no more bytes than stated.
            self._bytes += member.file_size
            if self._bytes > TUNING.npz_bytes:
                got = f"{self._bytes / 1e9:.3g} GB of arrays"
                limit = f"at most {TUNING.npz_bytes / 1e9:.3g} GB"
                raise self.error(member.filename, got, limit, "write larger logs as Parquet")
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
            # Simulators of several arms at once store arrays such as (T, 1, n) if they simulate one.
            if self._arrays[name].ndim > 2:
                self._arrays[name] = self._arrays[name].squeeze()
            if fields := self._arrays[name].dtype.names:
                do = "store its fields: numpy.savez(OTHER, **{x: array[x] for x in array.dtype.names})"
                raise self.error(name, f"a structured array ({', '.join(fields)})", "numbers", do)
        return self._arrays[name]

    def error(self, name: str, got: str, expected: str, do: str | None = None) -> LogError:
        """Return an error about the array of this name; other arguments as for `LogError`."""
        return LogError(got, file=self.file, element=f"array {name}", expected=expected, do=do)

    def joint_names(self) -> tuple[str, list[str]]:
        """Return the name of the array of joint names, and the joint names; ("", []) if there is none."""
        for name in filter(JOINT_NAMES.fullmatch, self.names):
            if self[name].dtype.kind in "US":
                return name, [x.decode() if isinstance(x, bytes) else x for x in self[name].ravel().tolist()]
        return "", []

    def is_vector(self, name: str) -> bool:
        """Return True if an array has the shape (T,), (T, 1) or (1, T): MATLAB stores vectors as matrices."""
        return max(self[name].shape, default=0) == self[name].size


def read_npz(file: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """Return one table per recording in an NPZ archive; only the arrays that the mapping names are read.

    If names of the mapping contain `{trajectory}`, the archive contains several recordings: with "t_{trajectory}", the
    arrays "t_a" and "t_b" are the times of the recordings "a" and "b".
    """
    arrays = NpzArrays(file)
    # If the archive has no times (setting `sample_rate`), the placeholder is searched in the names of other columns.
    patterns = [mapping.columns.t, *map(_matrix, map(mapping.pattern, mapping.quantities))]
    patterns += [re.sub(r"\[\d+\]$", "", mapping.column(*signal)) for signal in mapping.signals(joints)]
    patterns = [x for x in patterns if TRAJECTORY in x]
    if not patterns:
        return [_table(None, arrays, joints, mapping)]
    for names in patterns:
        # If the placeholder occurs several times in a name, its first occurrence becomes a wildcard and the others back
        # references to it. Several wildcards could take exponential time on long names.
        first, *others = map(re.escape, names.split(TRAJECTORY))
        pattern = re.compile(first + "(.+)" + r"\1".join(others), re.DOTALL)
        texts = [match[1] for match in map(pattern.fullmatch, arrays.names) if match]
        if texts:
            return [_table(text, arrays, joints, mapping.of_trajectory(text)) for text in texts]
    raise missing_columns(patterns[:1], arrays.names, file, mapping, joints)


def _matrix(pattern: str) -> str:
    """Return the name of the matrix of all joints, such as "q", for the name of a column, such as "q_{joint}"."""
    return pattern.replace("{joint}", "").rstrip("_")


def _table(recording: str | None, arrays: NpzArrays, joints: Sequence[str], mapping: LogMapping) -> LogTable:
    """Return the table of one recording of an archive; `recording` is its name, None if it is the only one.

    An archive may contain a matrix `q` (T, n) in place of n arrays `q_<joint>`. The mapping of the table then has names
    such as `q[2]`, column 2 of the matrix, in place of the name `q_<joint>`.
    """
    columns: dict[str, dict[str, str | None]] = {joint: {} for joint in joints}
    for quantity in mapping.quantities if joints else ():
        matrix = _matrix(mapping.pattern(quantity))
        if matrix in arrays.names and arrays[matrix].ndim > 1:
            order = _order(matrix, arrays, [mapping.log_name(joint) for joint in joints])
            for joint, index in zip(joints, order, strict=True):
                columns[joint][quantity] = f"{matrix}[{index}]"
    mapping = mapping.with_joint_columns(columns)
    # `vectors`: names of all columns in the mapping. A name is the name of an array that is a vector (T,), or of a
    # column of a matrix, such as data[0].
    vectors = {mapping.columns.t, *starmap(mapping.column, mapping.signals(joints))}

    def read(names: list[str] | None) -> pa.Table:
        return _longest(arrays) if names is None else _equally_long(arrays, names, vectors)

    # The schema has names without types, since the type of an array is known only after it is read.
    schema = pa.schema([(name, pa.null()) for name in arrays.names])
    return LogTable(schema, read, mapping, recording=recording)


def _equally_long(arrays: NpzArrays, names: Sequence[str], vectors: Collection[str]) -> pa.Table:
    """Return a table of the arrays `names`, all of T rows. Raises LogError if their lengths differ.

    An array (T,) becomes a column, and a matrix (T, n) a column of lists. vectors: names of arrays that are vectors,
    also if they have the shape (T, 1) or (1, T).
    """
    table: dict[str, pa.Array] = {}
    samples = None
    for name in names:
        array = arrays[name]
        is_matrix = array.ndim == 2 and name not in vectors
        length = len(array) if is_matrix else array.size
        samples = length if samples is None else samples
        if length != samples or not (is_matrix or arrays.is_vector(name)):
            expected, do = f"a value for each of the {samples} times", "resample it to these times"
            raise arrays.error(name, f"an array of shape {array.shape}", expected, do)
        # Arrow has no floating-point numbers of more than 64 bits, and accepts only the native byte order.
        # Floating-point numbers are therefore converted to double precision, others to the native byte order.
        wide = float if array.dtype.kind == "f" else array.dtype.newbyteorder("=")
        values = pa.array(array.astype(wide).ravel())
        table[name] = pa.FixedSizeListArray.from_arrays(values, array.shape[1]) if is_matrix else values
    return pa.table(table)


def _longest(arrays: NpzArrays) -> pa.Table:
    """Return a table of all arrays that have the largest number of rows in the archive, for the draft of a mapping.

    A matrix becomes a column of lists. Of an archive with several recordings (`_of_first_recording`), the table has the
    arrays of the first recording, whose names have the placeholder `{trajectory}`. Raises LogError for an array that
    may be transposed or one row too short.
    """
    shapes, faults = {}, []
    for name in arrays.names:
        try:
            shapes[name] = arrays[name].shape
        # Arrays that are no numbers, such as a dict with the settings of the recorder, contain no signals and are
        # skipped.
        except LogError as fault:
            faults.append(fault)
    collect([] if any(shapes.values()) else faults)
    of_recording = _of_first_recording(shapes)
    shapes = {name: shapes[name] for name in of_recording} or shapes
    samples = max(map(max, filter(None, shapes.values())), default=0)
    vectors = set(filter(arrays.is_vector, shapes))
    columns = [x for x, shape in shapes.items() if x in vectors or len(shape) == 2]
    chosen = [x for x in columns if samples == (arrays[x].size if x in vectors else len(arrays[x]))]
    for name, shape in sorted(shapes.items(), key=lambda item: -len(item[1])):
        # Arrays whose first axis has the length `samples`, but which are no columns (such as images), are skipped. If
        # another axis has this length, the array is a transposed signal. If an axis is longer or shorter by one, the
        # array is a signal at other times: a simulation may return one state more than inputs. Both are errors.
        if name not in chosen and shape[:1] != (samples,) and any(abs(x - samples) < 2 for x in shape):
            do = (
                "transpose it: rows are times"
                if shape[-1] == samples
                else "resample it, or split it by recordings"
            )
            raise arrays.error(
                name, f"an array of shape {shape}", f"a row for each of the {samples} times", do
            )
    table = _equally_long(arrays, chosen, vectors)
    table = table.rename_columns([of_recording.get(x, x) for x in table.column_names])
    return table.replace_schema_metadata({JOINTS_KEY: json.dumps(arrays.joint_names()[1])})


def _of_first_recording(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, str]:
    """Return {array of the first recording: its name with the placeholder `{trajectory}`}; {} for a single recording.

    Arrays of several recordings have names that differ in one number, such as `data/demo_0/q` and `data/demo_1/q`. They
    are matrices, or have different lengths: vectors of one length are signals of several joints. If another array of
    the archive, such as the times, has the same length, the arrays are signals of one recording, such as of two arms.

    shapes: {name of an array: its shape}.
    """
    numbers: dict[str, dict[str, str]] = {}  # {name with the placeholder: {number: name of the array}}
    for name in shapes:
        # Only the first numbers of a name are used, since the time is quadratic in their count.
        for number in islice(re.finditer(r"\d+", name), 4):
            pattern = name[: number.start()] + TRAJECTORY + name[number.end() :]
            numbers.setdefault(pattern, {})[number[0]] = name
    groups: dict[tuple[str, ...], list[str]] = {}  # {numbers of recordings: their names with the placeholder}
    for pattern, names in numbers.items():
        if len(names) > 1:
            groups.setdefault(tuple(names), []).append(pattern)
    for patterns in sorted(groups.values(), key=len, reverse=True):
        first = {next(iter(numbers[x].values())): x for x in patterns}
        lengths = [{shapes[name][:1] for name in numbers[x].values()} for x in patterns]
        is_matrix = any(len(shapes[x]) == 2 and min(shapes[x]) > 1 for x in first)
        is_divided = is_matrix or any(len(x) > 1 for x in lengths)
        others = shapes.keys() - {name for x in patterns for name in numbers[x].values()}
        if is_divided and max(shapes[x][:1] for x in first) not in {shapes[x][:1] for x in others}:
            return first
    return {}


def _order(matrix: str, arrays: NpzArrays, names: list[str]) -> list[int]:
    """Return the column of each joint in a matrix (T, n) of an archive. names: names of the arm's joints in the log.

    An array of names in the archive states the order of the columns; without it the order is the arm's.
    """
    rows, width, *further = arrays[matrix].shape
    if further:
        got, expected = f"an array of shape {arrays[matrix].shape}", "a row per time and a column per joint"
        raise arrays.error(matrix, got, expected, "store an array per recording, such as q_1, q_2")
    stored, logged = arrays.joint_names()
    if stored:
        absent = [name for name in names if name not in logged or len(logged) != width]
        if absent:
            expected = f"{absent[0]} among the names of the {width} columns of {matrix}"
            raise arrays.error(stored, f"the joints {', '.join(logged)}", expected)
        return [logged.index(name) for name in names]
    if width != len(names):
        do = "transpose it: rows are times" if rows == len(names) else "name them by an array 'joints'"
        raise arrays.error(matrix, f"{width} columns", f"{len(names)}, one for each joint", do)
    return list(range(width))
