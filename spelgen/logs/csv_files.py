"""Reader of CSV logs in the dialects of spreadsheets and loggers."""

import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa
import pyarrow.compute
import pyarrow.csv

from spelgen.errors import LogError
from spelgen.logs.bags import FIELDS
from spelgen.logs.tables import LogFormat, LogTable, table_layout
from spelgen.logs.values import is_number
from spelgen.settings.log_mapping import PLAIN, LogMapping

STAMP = ("sec", "nanosec", "frame_id")  # columns of the header of a message


class CsvText(NamedTuple):
    """Beginning of a CSV file.

    comments: lines before the header. header: names of the columns. others: lines after it without values, of units or
    the header again. rows: the text after them.
    """

    encoding: str
    comments: int
    header: str
    others: int
    rows: str


def read_csv(file: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """Return the one table of a file; a last line that is cut off is omitted, with a remark."""
    table, text, cut = _csv_table(file)
    remarks = (f"the last line is cut off and was left out: {cut:.30}",) if cut else ()
    layout = table_layout(table.schema, joints, mapping, file)
    header = text.comments + 1 + text.others
    return [(replace(layout, remarks=remarks, header=header), table)]


def csv_columns(file: Path) -> pa.Table:
    """Return the table of a file, see `_csv_table`."""
    return _csv_table(file)[0]


def _csv_table(file: Path) -> tuple[pa.Table, CsvText, str]:
    """Return a table of commas, semicolons or tabs, the file's beginning, and its last line if that is cut off.

    Numbers may have decimal commas, text may be UTF-8, UTF-16 or Latin-1. Joint states written by `ros2 topic echo
    --csv` have no header.
    """
    text = _beginning(file)
    delimiter = max(",;\t", key=text.header.count)
    cells = text.header.split(delimiter)
    names = _joint_state_columns(cells, file) if is_number(cells[0]) else None
    start = '"' if delimiter == "," else f"(^|{delimiter}) *"
    decimal_commas = re.search(rf"{start}-?\d+,\d", text.rows, re.MULTILINE)
    wrong: list[pa.csv.InvalidRow] = []

    def skipped(row: pa.csv.InvalidRow) -> str:
        # of the last line only: a recorder lost its power
        wrong.append(row)
        return "skip" if len(wrong) == 1 else "error"

    # one thread, and the system's allocator: memory is bounded and returned, and 17 MB take 0.02 s more
    table = pa.csv.read_csv(
        file,
        pa.csv.ReadOptions(
            use_threads=False, encoding=text.encoding, column_names=names,
            skip_rows=text.comments, skip_rows_after_names=text.others,
        ),
        pa.csv.ParseOptions(delimiter=delimiter, invalid_row_handler=skipped),
        pa.csv.ConvertOptions(decimal_point="," if decimal_commas else "."),
        memory_pool=pa.system_memory_pool(),
    )  # fmt: skip
    for row in wrong:
        if row.number is None or row.number < len(table) + 2 + text.comments + text.others or not len(table):
            got = f"{row.actual_columns} values ({row.text:.40})"
            expected = f"{row.expected_columns}, as in the header"
            raise LogError(got, file=file, line=row.number, expected=expected)
    if names is None:
        table = table.rename_columns([name.strip() for name in table.column_names])
    else:
        seconds, nanoseconds = table[STAMP[0]].cast(pa.int64()), table[STAMP[1]].cast(pa.int64())
        times = pa.compute.add(pa.compute.multiply(seconds, 1_000_000_000), nanoseconds)
        table = table.append_column(PLAIN["t"], times.cast(pa.duration("ns")))
    return table, text, wrong[0].text if wrong else ""


def _beginning(file: Path) -> CsvText:
    """Return the beginning of a file: comments start with #, lines of units have no digits."""
    encoding, head = _decoded_head(file)
    lines = head.splitlines() or [""]
    # at least one line remains as the header, and one as values
    comments = len(list(takewhile(lambda line: line.startswith("#"), lines[:-1])))
    header, rows = lines[comments], lines[comments + 1 :]
    others = len(list(takewhile(lambda row: row and (row == header or not re.search(r"\d", row)), rows[:-1])))
    return CsvText(encoding, comments, header, others, "\n".join(rows[others:]))


def _joint_state_columns(cells: Sequence[str], file: Path) -> list[str]:
    """Return names for the columns of joint states as `ros2 topic echo --csv` writes them, which has no header.

    Raises LogError for any other file that begins with numbers.
    """
    names = list(takewhile(lambda cell: not is_number(cell), cells[len(STAMP) :]))
    columns = [*STAMP, *(f"name_{name}" for name in names)]
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
    # of the head, from which encoding, delimiter and decimal point are detected
    size = 2**16
    with file.open("rb") as source:
        head = source.read(size)
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16", head.decode("utf-16", "ignore")
    # the head may end in the middle of a UTF-8 character
    errors = "strict" if len(head) < size else "ignore"
    try:
        return "utf-8", head.decode("utf-8", errors)
    except UnicodeDecodeError:
        return "latin-1", head.decode("latin-1")


CSV = LogFormat(read_csv, suffixes=(".csv",), columns=csv_columns)
