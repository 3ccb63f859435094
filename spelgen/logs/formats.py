"""Formats of logs, and the search for logs at given paths.

To add a format, write a module like `csv_files.py` and add a `LogFormat` to FORMATS.
"""

import pkgutil
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path

import pyarrow as pa

from spelgen.errors import LogError, SpelgenError
from spelgen.files import local, require_regular_file
from spelgen.logs.row_names import are_names, sorted_by_names
from spelgen.logs.tables import Layout, LogFormat, LogTable, reading, stored_columns, table_layout
from spelgen.settings.log_mapping import LogMapping

LogPaths = Path | str | Iterable[Path | str]
"""Paths of log files and of folders with logs, or their addresses (see `local`)."""

_PYTHON = 'python -c "import {}"'
_HDF5 = (
    "h5py, numpy; d = {{}}; h5py.File('{0}').visititems(lambda k, x: d.update({{k: x[()]}}) "
    "if isinstance(x, h5py.Dataset) else None); numpy.savez('{1}.npz', **d)"
)
# {suffix of a file that is no log: command that converts the file to a log}; in the command, {0} is the path of the
# file, and {1} the path without the suffix.
CONVERT = {
    ".zip": "unzip {0}", **dict.fromkeys((".tar", ".tgz"), "tar -xf {0}"),
    ".zstd": "zstd -d {0}", ".zst": "zstd -d {0}", ".gz": "gunzip {0}", ".xz": "unxz {0}", ".bz2": "bunzip2 {0}",
    **dict.fromkeys((".txt", ".dat", ".asc", ".log"), "mv {0} {1}.csv"),
    ".xlsx": _PYTHON.format("pandas; pandas.read_excel('{0}').to_csv('{1}.csv', index=False)"),
    **dict.fromkeys((".feather", ".arrow"), _PYTHON.format(
        "pandas; pandas.read_feather('{0}').to_parquet('{1}.parquet')"
    )),
    **dict.fromkeys((".pkl", ".pickle"), _PYTHON.format(
        "pandas; pandas.read_pickle('{0}').reset_index().to_parquet('{1}.parquet')"
    )),
    **dict.fromkeys((".yaml", ".yml"), _PYTHON.format(
        "json, yaml; open('{1}.jsonl', 'w').writelines("
        "json.dumps(x) + chr(10) for x in yaml.load_all(open('{0}'), yaml.CSafeLoader) if x)"
    )),
    ".npy": _PYTHON.format("numpy; numpy.savetxt('{1}.csv', numpy.load('{0}'), delimiter=',', header='NAMES')"),
    # A .npy file of a dict is a pickle, which is loaded only with a warning.
    ".npy with a dict": _PYTHON.format(
        "numpy; numpy.savez('{1}.npz', **numpy.load('{0}', allow_pickle=True).item())"
    ) + ' (only a file of a known source: pickles may contain code)',
    # The file is converted to JSON and not to NPZ: JSON can represent structs, whose fields are then read as columns
    # such as x.q. NPZ would contain structs as Python objects, which are not read.
    ".mat": _PYTHON.format(
        "json, scipy.io; json.dump(scipy.io.loadmat('{0}', simplify_cells=True), open('{1}.json', 'w'), "
        "default=lambda x: x.tolist() if hasattr(x, 'tolist') else str(x))"
    ),
    # MATLAB stores the columns of a matrix as rows of HDF5.
    ".mat of version 7.3": _PYTHON.format(_HDF5.replace("x[()]", "x[()].T")),
    **dict.fromkeys((".h5", ".hdf5"), _PYTHON.format(_HDF5)),
}  # fmt: skip


def _lazy(name: str) -> Callable[..., list[LogTable]]:
    """Return the function `name` ("module:function") of this package, whose module is imported when it is first called.

    Most users have logs in one format, and the reader of each format imports another library.
    """
    return lambda *arguments: pkgutil.resolve_name(f"spelgen.logs.{name}")(*arguments)


PARQUET = LogFormat(_lazy("parquet_files:read_parquet"), (".parquet",))
CSV = LogFormat(_lazy("csv_files:read_csv"), (".csv", ".tsv"))
NPZ = LogFormat(_lazy("npz:read_npz"), (".npz",))
JSON_LINES = LogFormat(_lazy("parquet_files:read_json_lines"), (".jsonl", ".ndjson"))
JSON = LogFormat(_lazy("parquet_files:read_json_document"), (".json",))
BAG = LogFormat(_lazy("bags:read_bag"), (".mcap", ".db3", ".bag"), "metadata.yaml", "a ROS 2 bag")
LEROBOT = LogFormat(_lazy("parquet_files:read_dataset"), marker="meta/info.json", folder="a LeRobot data set")
FORMATS = [PARQUET, CSV, NPZ, JSON_LINES, JSON, BAG, LEROBOT]


def format_of(path: Path) -> LogFormat | None:
    """Return the log format of a file or folder; None if it is not a log. A pipe is no log: reading might not end."""
    for log_format in FORMATS:
        is_folder = log_format.marker and (path / log_format.marker).is_file()
        if is_folder or (path.suffix.lower() in log_format.suffixes and path.is_file()):
            return log_format
    return None


def read_tables(path: Path, joints: Sequence[str], mapping: LogMapping) -> Iterator[tuple[Layout, pa.Table]]:
    """Yield the layout and the table of each recording of a log, one at a time, read by the reader of its format.

    path: file or folder, one of the results of `log_files`. Raises LogError for a damaged file and for missing columns.
    """
    log_format = format_of(path)
    assert log_format is not None, "log_files gives logs alone"
    with reading(path):
        for log in log_format.read(path, joints, mapping):
            layout = table_layout(log, joints, path)
            names = [x.name for x in log.schema if are_names(x)]
            table = log.read([*stored_columns(layout, log.schema.names), *names])
            of_columns = [layout.mapping.log_name(joint) for _, joint in layout.mapping.signals(joints)]
            yield layout, sorted_by_names(table, dict(zip(layout.columns[1:], of_columns, strict=True)))


def log_files(paths: LogPaths, role: str | None = None) -> tuple[list[Path], list[SpelgenError]]:
    """Return the log files and log folders at these paths, each once, and one error for each path without a log.

    role: "train" or "test". If a folder contains files named train.* or test.*, only the files named after the role
    are used. None: all logs of a folder are used.
    """
    files: dict[Path, None] = {}
    errors: list[SpelgenError] = []
    for name in [paths] if isinstance(paths, str | Path) else paths:
        path = local(name)
        try:
            if not path.exists():
                raise LogError("no such file or folder", file=name, expected="a log", do="check the path")
            files |= dict.fromkeys(_logs_at(path, role))
        except LogError as error:
            errors.append(error)
    return list(files), errors


def _conversion(path: Path) -> str | None:
    """Return the advice, for an error message, to convert a file by a command in CONVERT; None for other files."""
    suffix = path.suffix.lower()
    if suffix in (".txt", ".log", ".mat", ".npy") and path.is_file():
        with path.open("rb") as source:
            head = source.read(128)
        # The documents of `ros2 topic echo` are YAML in a file of any name.
        contents = {
            b"header:": ".yaml",
            b"MATLAB 7.3": ".mat of version 7.3",
            b"'descr': '|O'": ".npy with a dict",
        }
        suffix = next((x for text, x in contents.items() if text in head), suffix)
    command = CONVERT.get(suffix)
    # FILE replaces a path with spaces or quotation marks, which a shell would split into arguments or execute as code.
    plain = path if re.fullmatch(r"[\w./@+-]+", str(path)) else Path("FILE").with_suffix(path.suffix)
    return command and f"convert it: {command.format(plain, plain.with_suffix(''))}"


def _logs_at(path: Path, role: str | None) -> list[Path]:
    if format_of(path) is not None:
        return [path]
    suffixes = ", ".join(chain(*(log_format.suffixes for log_format in FORMATS)))
    folders = " or of ".join(log_format.folder for log_format in FORMATS if log_format.folder)
    formats = f"{suffixes}, the folder of {folders}"
    if not path.is_dir():
        require_regular_file(path, LogError, f"a file: {formats}")
        raise LogError(f"a file of kind {path.suffix!r}", file=path, expected=formats, do=_conversion(path))
    # hidden files are no logs: macOS writes "._log.csv" in addition to log.csv on foreign file systems
    logs = sorted(x for x in path.iterdir() if format_of(x) is not None and not x.name.startswith("."))
    # JSON files in a folder with other logs are metadata.
    logs = [x for x in logs if format_of(x) is not JSON] or logs
    if not logs:
        packed = next(filter(None, map(_conversion, sorted(path.iterdir()))), None)
        if any(format_of(x) for x in path.glob("*/*")):
            packed = "name the folders in it, which have logs"
        raise LogError("a folder without logs", file=path, expected=formats, do=packed)
    # All logs of a folder are used if no file of the folder is named train.* or test.*.
    selected = [log for log in logs if log.stem == role]
    if selected or role is None or {"train", "test"}.isdisjoint(log.stem for log in logs):
        return selected or logs
    got, expected = f"a folder without {role}.* among its logs", f"{role}.*, or files by name"
    raise LogError(got, file=path, expected=expected)
