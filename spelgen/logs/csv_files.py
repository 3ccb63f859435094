"""Reader of CSV logs in the dialects of spreadsheets and loggers."""

import codecs
import csv
import json
import re
from collections.abc import Sequence
from itertools import pairwise, takewhile, zip_longest
from pathlib import Path
from statistics import mode
from typing import NamedTuple

import pyarrow as pa
import pyarrow.csv

from spelgen.errors import LogError
from spelgen.logs.bags import FIELDS
from spelgen.logs.tables import STATED_KEY, LogTable
from spelgen.logs.values import is_number, stamps
from spelgen.settings.log_mapping import PLAIN, LogMapping, is_unit, plain_unit

# First columns of a file that `ros2 topic echo --csv` writes: the fields of the message header.
STAMP = ("sec", "nanosec", "frame_id")
# Beginning of a comment line: "#" or "% ". A "%" without a blank is no comment: `rostopic echo -p` names a column
# "%time".
COMMENT = re.compile(r"^(#|% )\s*")


# Texts that are no value, in addition to the texts that Arrow recognises.
NO_VALUE = ["-", "--", "---", "None", "missing", "nan(ind)", "-nan(ind)", "1.#INF", "-1.#INF"]
NO_VALUE += ["#DIV/0!", "#NUM!", "#VALUE!", "#REF!", *pa.csv.ConvertOptions().null_values]


class Beginning(NamedTuple):
    """Beginning of a CSV file, up to the first row of values.

    Attributes:
        encoding: text encoding of the file.
        delimiter: character between columns.
        names: names of the columns; for a file without a header, the values of its first row.
        lines: number of lines before the first row of values: comments, the header, and lines such as units.
        units: units of the columns, from a line below the header, in lower case; [] without such a line.
        rows: the first rows of values.
    """

    encoding: str
    delimiter: str
    names: list[str]
    lines: int
    units: list[str]
    rows: str


def read_csv(file: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """Return the content of a CSV file as a list of one table; an incomplete last line is omitted, with a remark.

    If the header is repeated between the rows, one table per recording is returned: a new recording begins at a header
    after which the times do not increase.
    """
    table, header, cut = csv_table(file)
    remarks = (f"the last line is cut off and was left out: {cut:.30}",) if cut else ()
    is_text = table.num_columns and pa.types.is_string(table.schema.types[0])
    is_repeated = is_text and pa.compute.index(table[0], table.column_names[0]).as_py() >= 0
    if not is_repeated or mapping.columns.trajectory in table.column_names:
        return [LogTable.of(table, mapping, remarks=remarks, header=header)]
    tables: list[tuple[pa.Table, int]] = []
    text, last = _beginning(file), None
    lines = [line.lstrip("\ufeff") for line in file.read_text(text.encoding).splitlines()]
    starts = [k for k, line in enumerate(lines, start=1) if line == lines[header - 1]]
    for start, stop in pairwise([*starts, len(lines) + 1]):
        # A comment line "#" is added, so that the text is never empty: `csv_table` reads the whole file for an empty
        # text.
        segment, _, _ = csv_table(file, text, "\n".join([*lines[start : stop - 1], "#"]))
        t = mapping.columns.t if mapping.columns.t in segment.column_names else segment.column_names[0]
        times = segment[t].drop_null().to_pylist()
        if not times:
            continue
        if tables and segment.schema == tables[-1][0].schema and times[0] > last:
            start, segment = tables[-1][1], pa.concat_tables([tables.pop()[0], segment])
        tables.append((segment, start))
        last = times[-1]
    return [
        LogTable.of(x, mapping, remarks=remarks, header=start, recording=str(k) if len(tables) > 1 else None)
        for k, (x, start) in enumerate(tables, start=1)
    ]


def csv_table(file: Path, text: Beginning | None = None, rows: str = "") -> tuple[pa.Table, int, str]:
    """Return the table of a CSV file, the number of lines before the values, and the text of an incomplete last line.

    text: beginning of the file, None: it is read from the file. rows: lines of values of the file that become the
    table, "": all lines are used.

    Columns may be separated by commas, semicolons, tabs, bars or spaces; numbers may have decimal commas; the encoding
    may be UTF-8, UTF-16 or Latin-1. Files without a header are accepted if `ros2 topic echo --csv` wrote them.
    """
    text = text or _beginning(file)
    names = _joint_state_columns(text.names, file) if is_number(text.names[0]) else None
    start = '"' if text.delimiter == "," else f'(^|{re.escape(text.delimiter)}) *"?'
    decimal_point = "," if re.search(rf"{start}-?\d+,\d", text.rows, re.MULTILINE) else "."
    wrong: list[pa.csv.InvalidRow] = []

    def skipped(row: pa.csv.InvalidRow) -> str:
        if not COMMENT.match(row.text):
            wrong.append(row)
        return "skip" if len(wrong) < 2 else "error"

    # Two forms that Arrow cannot read are replaced: several spaces that align columns, by one space, and exponents of
    # Fortran (1.0D-02), by E.
    exponent = r"(?<=[\d.])[dD](?=[+-]\d\d)"
    spaces = "^ +| +$| +(?= )" if text.delimiter == " " else "(?!)"
    skipped_lines = 0 if rows else text.lines
    if re.search(f"{exponent}|{spaces}", text.rows, re.MULTILINE):
        rows = re.sub(exponent, "E", rows or file.read_text(text.encoding))
        rows = re.sub(spaces, "", rows, flags=re.MULTILINE)
    # With one thread and the system's allocator, Arrow needs less memory and frees it after use. Reading 17 MB takes
    # 0.02 s longer.
    encoding = "utf-8" if rows else text.encoding
    table = pa.csv.read_csv(
        pa.BufferReader(rows.encode()) if rows else file,
        pa.csv.ReadOptions(
            use_threads=False, encoding=encoding, skip_rows=skipped_lines, column_names=names or text.names
        ),
        pa.csv.ParseOptions(delimiter=text.delimiter, invalid_row_handler=skipped),
        pa.csv.ConvertOptions(decimal_point=decimal_point, null_values=NO_VALUE),
        memory_pool=pa.system_memory_pool(),
    )
    # Only the last line may be incomplete, as after a power failure of the recorder. Any other incomplete line is an
    # error.
    for row in wrong:
        if not len(table) or row.number <= skipped_lines + len(table):
            got = f"{row.actual_columns} values ({row.text:.40})"
            expected = f"{row.expected_columns}, as in the header"
            raise LogError(got, file=file, line=row.number, expected=expected)
    if names is not None:
        table = table.append_column(PLAIN["t"], stamps(table[STAMP[0]], table[STAMP[1]]))
    if text.units:
        units = dict(zip(text.names, text.units, strict=False))
        table = table.replace_schema_metadata({STATED_KEY: json.dumps(units)})
    return table, text.lines, wrong[0].text if wrong else ""


def _beginning(file: Path) -> Beginning:
    """Return encoding, delimiter, column names and first rows of a CSV file, detected from its first 128 KiB."""
    encoding, head = _decoded_head(file)
    lines = head.lstrip("\ufeff").splitlines() or [""]
    delimiter, cells, width = _divided(lines)
    header = _header_row(lines, cells, width)
    names, start = cells[header], header
    units: list[str] = []
    if not is_number(names[0]):
        names, start = _column_names(lines, cells, header)
        names = names + [""] * (width - len(names))
        units = [plain_unit(x) for x in cells[start - 1]]
        # A line of names may contain words such as `deg`. It counts as a line of units only if more than half of its
        # nonempty cells are units.
        units = units if sum(map(is_unit, units)) > sum(map(bool, units)) / 2 else []
    return Beginning(encoding, delimiter, names, start, units, "\n".join(lines[start:]))


def _divided(lines: Sequence[str]) -> tuple[str, list[list[str]], int]:
    """Detect the delimiter of CSV lines. Return it, the cells of each line, and the most frequent number of cells."""
    # Spaces and commas are tried last as delimiters: column names may contain spaces, and numbers decimal commas.
    for delimiter in "\t;|, ":
        cells = [_cells(COMMENT.sub("", line), delimiter) for line in lines]
        width = mode(map(len, cells[:-1] or cells))
        if width > 2:
            break
    return delimiter, cells, width


def _header_row(lines: Sequence[str], cells: Sequence[Sequence[str]], width: int) -> int:
    """Return the index of the header, or of the first row of values in a file without a header.

    The header is the first line that has `width` cells, the number of cells of most lines, and is no comment. If this
    line has values and a comment with `width` cells precedes it, the comment is the header.
    """
    # Rows of values may all end with a delimiter. Their last cell is then empty, and the header may have one cell less.
    is_ended = all(row[-1] == "" for row in cells[1:-1] if len(row) == width)
    full = [k for k, row in enumerate(cells) if len(row) in (width, width - is_ended)] or [0]
    first = next((k for k in full if not COMMENT.match(lines[k])), full[0])
    previous = full.index(first) - 1
    return full[previous] if previous >= 0 and is_number(cells[first][0]) else first


def _column_names(lines: Sequence[str], cells: Sequence[list[str]], header: int) -> tuple[list[str], int]:
    """Return the names of the columns of a CSV file, and the index of the first line of values.

    Between header and values there may be lines without digits, such as units, and repeats of the header. Names may be
    in two lines: the first line has the quantities, each repeated for all joints or only above its first joint; the
    second line has the joints.

    lines, cells: text and cells of each line. header: index of the header.
    """
    names, start = cells[header], header + 1
    is_repeated = len(set(names)) < len(names) - 1
    while start < len(lines) - 1 and _is_text(lines[start], lines[header], cells[start]):
        start += 1
    if is_repeated and start > header + 1:
        filled = names[:1]
        for name in names[1:]:
            filled.append(name or filled[-1])
        columns = zip_longest(filled, *cells[header + 1 : start], fillvalue="")
        names = ["_".join(filter(None, dict.fromkeys(column))) for column in columns]
    return names, start


def _is_text(line: str, header: str, cells: Sequence[str]) -> bool:
    """Return True if a line below the header of a CSV file has no values: units, names, or the header again.

    Names and units may have digits, such as "joint1" and "m/s2". A value is a cell that is a number, or has a number or
    a time in its text, such as "[0.1, 0.2]" and "10:00:00".
    """
    has_values = any(map(is_number, cells)) or re.search(r"\d[.,:]\d", line)
    return bool(line) and (line == header or not has_values)


def _cells(line: str, delimiter: str) -> list[str]:
    """Return the cells of a CSV line, without their quotation marks; several spaces are one delimiter."""
    cells = line.split() if delimiter == " " else next(csv.reader([line], delimiter=delimiter), [])
    return [cell.strip() for cell in cells] or [""]


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
    """Return the text encoding of a file (UTF-8, UTF-16 or Latin-1), and its first characters."""
    # [B] size of the head of the file, from which names, encoding, delimiter and decimal point are detected. It is as
    # large as the largest cell that the module csv reads.
    size = 2**17
    with file.open("rb") as source:
        head = source.read(size)
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16", head.decode("utf-16", "ignore")
    # UTF-16 without a mark of the byte order: one of the two bytes of the first character, a Latin letter, is 0.
    if 0 in head[:2] and head[:2] != b"\0\0":
        encoding = "utf-16-le" if head[1] == 0 else "utf-16-be"
        return encoding, head.decode(encoding, "ignore")
    try:
        # The head of the file may end in the middle of a UTF-8 character, which the incremental decoder omits.
        return "utf-8", codecs.getincrementaldecoder("utf-8")().decode(head, final=len(head) < size)
    except UnicodeDecodeError:
        return "latin-1", head.decode("latin-1")
