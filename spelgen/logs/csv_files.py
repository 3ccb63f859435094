"""Reader of CSV logs in the dialects of spreadsheets and loggers."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.compute
import pyarrow.csv

from spelgen.errors import LogError
from spelgen.logs.bags import FIELDS
from spelgen.logs.tables import LogFormat, LogTable, table_layout
from spelgen.logs.tuning import TUNING
from spelgen.logs.values import is_number
from spelgen.settings.log_mapping import PLAIN, LogMapping

STAMP = ("sec", "nanosec", "frame_id")  # columns of the header of a message


def read_csv(file: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """Return a list with the table of a file."""
    table = csv_columns(file)
    return [(table_layout(table.schema, joints, mapping, file), table)]


def csv_columns(file: Path) -> pa.Table:
    """Return a table separated by commas, semicolons or tabs; with semicolons or tabs, decimal commas are possible.

    Text may be UTF-8, UTF-16 or Latin-1. Joint states written by `ros2 topic echo --csv` have no header.
    """
    encoding, head = _decoded_head(file)
    first_line, _, rows = head.partition("\n")
    delimiter = max(",;\t", key=first_line.count)
    cells = first_line.split(delimiter)
    names = _joint_state_columns(cells, file) if is_number(cells[0]) else None
    decimal_commas = delimiter != "," and re.search(rf"(^|{delimiter}) *-?\d+,\d", rows, re.MULTILINE)
    # one thread, and the system's allocator: memory is bounded and returned, and 17 MB take 0.02 s more
    table = pa.csv.read_csv(
        file,
        pa.csv.ReadOptions(use_threads=False, encoding=encoding, column_names=names),
        pa.csv.ParseOptions(delimiter=delimiter),
        pa.csv.ConvertOptions(decimal_point="," if decimal_commas else "."),
        memory_pool=pa.system_memory_pool(),
    )
    if names is None:
        return table.rename_columns([name.strip() for name in table.column_names])
    seconds, nanoseconds = table[STAMP[0]].cast(pa.int64()), table[STAMP[1]].cast(pa.int64())
    times = pa.compute.add(pa.compute.multiply(seconds, 1_000_000_000), nanoseconds)
    return table.append_column(PLAIN["t"], times.cast(pa.duration("ns")))


def _joint_state_columns(cells: Sequence[str], file: Path) -> list[str]:
    """Return names for the columns of joint states as `ros2 topic echo --csv` writes them, which has no header.

    Raises LogError for any other file that begins with numbers.
    """
    columns = [*STAMP]
    names: list[str] = []
    for cell in cells[len(STAMP) :]:
        if is_number(cell):
            break
        names.append(cell)
        columns.append(f"name_{cell}")
    labels = len(columns)
    for quantity in FIELDS:
        if len(columns) < len(cells):
            columns += [PLAIN[quantity].replace("{joint}", name) for name in names]
    if not names or len(columns) == labels or len(columns) != len(cells):
        raise LogError(
            f"numbers in the first line ({', '.join(cells[:3])}, ...)", file=file, line=1,
            expected="a header: the names of the columns",
            do="write one, t,q_<joint>,...,qd_<joint>,...,tau_<joint>,... for example",
        )  # fmt: skip
    return columns


def _decoded_head(file: Path) -> tuple[str, str]:
    """Return the encoding and the first characters of a file."""
    with file.open("rb") as source:
        head = source.read(TUNING.csv_head)
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16", head.decode("utf-16", "ignore")
    # the head may end in the middle of a UTF-8 character
    errors = "strict" if len(head) < TUNING.csv_head else "ignore"
    try:
        return "utf-8", head.decode("utf-8", errors)
    except UnicodeDecodeError:
        return "latin-1", head.decode("latin-1")


CSV = LogFormat(read_csv, suffixes=(".csv",), columns=csv_columns)
