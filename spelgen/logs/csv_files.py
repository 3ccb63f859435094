"""Reader of CSV logs in the dialects of spreadsheets and loggers."""

import codecs
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
from spelgen.logs.tables import LogTable, table_layout
from spelgen.logs.values import is_number
from spelgen.settings.log_mapping import PLAIN, LogMapping

# first columns that `ros2 topic echo --csv` writes: the header of the message
STAMP = ("sec", "nanosec", "frame_id")


class Beginning(NamedTuple):
    """Beginning of a CSV file, divided into comments, header, other lines and rows of values.

    Attributes:
        encoding: text encoding of the file.
        comments: number of comment lines before the header.
        header: the header line.
        others: number of lines between the header and the first row of values, such as a line of units.
        rows: the first rows of values.
    """

    encoding: str
    comments: int
    header: str
    others: int
    rows: str


def read_csv(file: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """Return a list with one table, the content of a CSV file; an incomplete last line is omitted, with a remark."""
    table, header, cut = _csv_table(file)
    remarks = (f"the last line is cut off and was left out: {cut:.30}",) if cut else ()
    return [
        (replace(table_layout(table.schema, joints, mapping, file), remarks=remarks, header=header), table)
    ]


def csv_columns(file: Path) -> pa.Table:
    """Return all columns of a CSV file as logged."""
    return _csv_table(file)[0]


def _csv_table(file: Path) -> tuple[pa.Table, int, str]:
    """Return the table of a CSV file, the number of lines before the values, and the text of an incomplete last line.

    Columns may be separated by commas, semicolons, tabs, bars or single spaces; numbers may have decimal commas; the
    encoding may be UTF-8, UTF-16 or Latin-1. Files without a header are accepted if `ros2 topic echo --csv` wrote them.
    """
    text = _beginning(file)
    # Names of columns may contain spaces, so spaces are the delimiter only if the header contains no other delimiter.
    delimiter = max(",;\t|", key=text.header.count)
    if delimiter not in text.header:
        delimiter = " "
    cells = text.header.split(delimiter)
    names = _joint_state_columns(cells, file) if is_number(cells[0]) else None
    start = '"' if delimiter == "," else f"(^|{re.escape(delimiter)}) *"
    decimal_point = "," if re.search(rf"{start}-?\d+,\d", text.rows, re.MULTILINE) else "."
    wrong: list[pa.csv.InvalidRow] = []

    def skipped(row: pa.csv.InvalidRow) -> str:
        wrong.append(row)
        return "skip" if len(wrong) == 1 else "error"

    # Arrow reads with one thread and with the system's allocator, which limits the memory and frees it after use. This
    # costs 0.02 s for 17 MB.
    rows = {"skip_rows": text.comments, "skip_rows_after_names": text.others, "column_names": names}
    table = pa.csv.read_csv(
        file,
        pa.csv.ReadOptions(use_threads=False, encoding=text.encoding, **rows),
        pa.csv.ParseOptions(delimiter=delimiter, invalid_row_handler=skipped),
        pa.csv.ConvertOptions(decimal_point=decimal_point),
        memory_pool=pa.system_memory_pool(),
    )
    header = text.comments + 1 + text.others
    # Only the last line may be incomplete, as after a power failure of the recorder. Any other incomplete line is an
    # error.
    for row in wrong:
        if not len(table) or row.number <= header + len(table):
            got = f"{row.actual_columns} values ({row.text:.40})"
            raise LogError(
                got, file=file, line=row.number, expected=f"{row.expected_columns}, as in the header"
            )
    if names is None:
        table = table.rename_columns([name.strip() for name in table.column_names])
    else:
        seconds, nanoseconds = table[STAMP[0]].cast(pa.int64()), table[STAMP[1]].cast(pa.int64())
        times = pa.compute.add(pa.compute.multiply(seconds, 1_000_000_000), nanoseconds)
        table = table.append_column(PLAIN["t"], times.cast(pa.duration("ns")))
    return table, header, wrong[0].text if wrong else ""


def _beginning(file: Path) -> Beginning:
    """Return the beginning of a CSV file, in which comments start with # and a line of units contains no digits."""
    encoding, head = _decoded_head(file)
    lines = head.splitlines() or [""]
    # The last line of the head never counts as a comment, so that there is always a header.
    comments = len(list(takewhile(lambda line: line.startswith("#"), lines[:-1])))
    header, rows = lines[comments], lines[comments + 1 :]
    skipped = list(takewhile(lambda x: x and (x == header or not re.search(r"\d", x)), rows[:-1]))
    return Beginning(encoding, comments, header, len(skipped), "\n".join(rows[len(skipped) :]))


def _joint_state_columns(cells: Sequence[str], file: Path) -> list[str]:
    """Return the column names of a file that `ros2 topic echo --csv` wrote without a header.

    cells: values of the first line, which contains the joint names after the time stamp.

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
    # [B] size of the head of the file, from which encoding, delimiter and decimal point are detected
    size = 2**16
    with file.open("rb") as source:
        head = source.read(size)
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16", head.decode("utf-16", "ignore")
    try:
        # the head may end in the middle of a UTF-8 character
        return "utf-8", codecs.getincrementaldecoder("utf-8")().decode(head, final=len(head) < size)
    except UnicodeDecodeError:
        return "latin-1", head.decode("latin-1")
