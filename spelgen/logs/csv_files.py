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
from spelgen.logs.column_names import KNOWN
from spelgen.logs.tables import STATED_KEY, LogTable
from spelgen.logs.tuning import TUNING
from spelgen.logs.values import is_number, stamps
from spelgen.settings.log_mapping import PLAIN, LogMapping, is_unit, plain_unit

# First columns of a file that `ros2 topic echo --csv` writes: the fields of the message header.
STAMP = ("sec", "nanosec", "frame_id")
# Beginning of a comment line: "#" or "% ". A "%" without a blank is no comment: `rostopic echo -p` names a column
# "%time".
COMMENT = re.compile(r"^(#|% )\s*")


# First cell of a line with statistics of the columns, or of an end mark: a word, or a quantile such as "25%".
STATISTIC = re.compile(r"[^\W\d]\D*|\d+ ?%")
# Texts that are no value, in addition to the texts that Arrow recognises.
NO_VALUE = ["-", "--", "---", "None", "missing", "nan(ind)", "-nan(ind)", "1.#INF", "-1.#INF"]
NO_VALUE += ["#DIV/0!", "#NUM!", "#VALUE!", "#REF!", *pa.csv.ConvertOptions().null_values]


# [B] size of the head of a file, from which names, encoding, delimiter and decimal point are detected. It is as large
# as the largest cell that the module csv reads.
HEAD = 2**17
# Character sets of spreadsheets, the most frequent first.
CHARACTER_SETS = ("latin-1", "cp932", "gb18030", "cp949", "cp1251")


class Beginning(NamedTuple):
    """Beginning of a CSV file, up to the first row of values.

    Attributes:
        delimiter: character between columns.
        names: names of the columns; for a file without a header, the values of its first row.
        header: text of the header; "" for a file without a header.
        lines: number of lines before the first row of values: comments, the header, and lines such as units.
        units: units of the columns, from a line above or below the header, in lower case; [] without such a line.
        rows: the first rows of values.
    """

    delimiter: str
    names: list[str]
    header: str
    lines: int
    units: list[str]
    rows: str


def read_csv(file: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """Return the tables of a CSV file: one table, or one per recording if the header is repeated between the rows.

    A new recording begins at a repeated header after which the times do not increase. Incomplete lines and lines
    without values after the last row of numbers are omitted, which a remark of the table states.
    """
    content = _in_utf8(file.read_bytes())
    # Repetitions of the header are searched. A repetition begins at the start of a line, or after the byte order mark
    # of a file that was appended.
    header = re.escape(_beginning(content).header.encode())
    starts = [x.start() for x in re.finditer(header + rb"(?=[\r\n])", content)] if header else []
    starts = [0, *[x for x in starts if content[max(x - 1, 0) : x] in (b"", b"\n", b"\r", b"\xbf")][1:]]
    tables: list[tuple[pa.Table, int]] = []
    remarks: tuple[str, ...] = ()
    last, above = None, 0
    for start, stop in pairwise([*starts, len(content)]):
        segment, lines, remarks = csv_table(file, content[start:stop] if len(starts) > 1 else content)
        if len(starts) > 1:
            lines, above = lines + above, above + len(content[start:stop].splitlines())
            t = mapping.columns.t if mapping.columns.t in segment.column_names else segment.column_names[0]
            times = segment[t].drop_null().to_pylist()
            if not times:
                continue
            is_labelled = mapping.columns.trajectory in segment.column_names
            if tables and segment.schema == tables[-1][0].schema and (is_labelled or times[0] > last):
                lines, segment = tables[-1][1], pa.concat_tables([tables.pop()[0], segment])
            last = times[-1]
        tables.append((segment, lines))
    return [
        LogTable.of(x, mapping, remarks=remarks, header=lines, recording=str(k) if len(tables) > 1 else None)
        for k, (x, lines) in enumerate(tables, start=1)
    ]


def csv_table(file: Path, content: bytes = b"") -> tuple[pa.Table, int, tuple[str, ...]]:
    """Return the table of a CSV file, the number of lines before the values, and a remark on omitted last lines.

    content: content of the file, or a part that begins with a header, in UTF-8; b"": the file is read.

    Columns may be separated by commas, semicolons, tabs, bars or spaces; numbers may have decimal commas. Files without
    a header are accepted if `ros2 topic echo --csv` wrote them.
    """
    content = content or _in_utf8(file.read_bytes())
    text = _beginning(content)
    content, footer = _without_footer(content, text)
    names = _joint_state_columns(text.names, file) if is_number(text.names[0]) else None
    # pandas writes the index of a table, often its times, as a first column without a name.
    columns = names or [name or f"column {k}" for k, name in enumerate(text.names, start=1)]
    start = '"' if text.delimiter == "," else f'(^|{re.escape(text.delimiter)}) *"?'
    decimal_point = "," if re.search(rf"{start}-?\d+,\d", text.rows, re.MULTILINE) else "."
    wrong: list[pa.csv.InvalidRow] = []

    def skipped(row: pa.csv.InvalidRow) -> str:
        if not COMMENT.match(row.text):
            wrong.append(row)
        return "skip" if len(wrong) <= TUNING.ending else "error"

    # Two forms that Arrow cannot read are replaced: several spaces that align columns, by one space, and exponents of
    # Fortran (1.0D-02), by E.
    exponent = r"(?<=[\d.])[dD](?=[+-]\d\d)"
    spaces = "^ +| +$| +(?= )" if text.delimiter == " " else "(?!)"
    if re.search(f"{exponent}|{spaces}", text.rows, re.MULTILINE):
        rows = re.sub(exponent, "E", content.decode())
        content = re.sub(spaces, "", rows, flags=re.MULTILINE).encode()
    # Arrow reads with one thread and with the system's allocator, which limits the memory and frees it after use. This
    # costs 0.02 s for 17 MB.
    table = pa.csv.read_csv(
        pa.BufferReader(content),
        pa.csv.ReadOptions(use_threads=False, skip_rows=text.lines, column_names=columns),
        pa.csv.ParseOptions(delimiter=text.delimiter, invalid_row_handler=skipped),
        pa.csv.ConvertOptions(decimal_point=decimal_point, null_values=NO_VALUE),
        memory_pool=pa.system_memory_pool(),
    )
    # Incomplete lines are permitted only after the last complete row of the table, as after a power failure of the
    # recorder. An incomplete line between complete rows is an error.
    for row in wrong:
        if not len(table) or row.number <= text.lines + len(table):
            got = f"{row.actual_columns} values ({row.text:.40})"
            expected = f"{row.expected_columns}, as in the header"
            raise LogError(got, file=file, line=row.number, expected=expected)
    if names is not None:
        table = table.append_column(PLAIN["t"], stamps(table[STAMP[0]], table[STAMP[1]]))
    if text.units:
        units = dict(zip(text.names, text.units, strict=False))
        table = table.replace_schema_metadata({STATED_KEY: json.dumps(units)})
    omitted = [*(row.text for row in wrong), *footer]
    if not omitted:
        return table, text.lines, ()
    several = f"{len(omitted)} lines are no rows and were"
    ending = several if len(omitted) > 1 else "line is no complete row and was"
    return table, text.lines, (f"the last {ending} left out: {omitted[0]:.30}",)


def _without_footer(content: bytes, text: Beginning) -> tuple[bytes, list[str]]:
    """Return the content of a CSV file without the lines at its end that begin with a word, and these lines.

    They are statistics of the columns (`Mean,0.1,...`) or an end mark, unless the rows begin with a word, too.
    """

    def begins_with_word(line: str) -> bool:
        cell = _cells(line, text.delimiter)[0]
        return bool(STATISTIC.fullmatch(cell)) and not is_number(cell) and cell not in NO_VALUE

    # Arrow would read the first column as text if one of its cells is a word.
    lines = content[-HEAD:].decode(errors="replace").splitlines(keepends=True)
    end = list(takewhile(lambda line: not line.strip() or begins_with_word(line), reversed(lines)))
    words = [line.strip() for line in reversed(end) if line.strip()]
    first = text.rows.split("\n", 1)[0]
    if not first or begins_with_word(first) or len(words) > TUNING.ending:
        return content, []
    return content[: len(content) - len("".join(end).encode())], words


def _beginning(content: bytes) -> Beginning:
    """Return delimiter, column names and first rows of a CSV file (in UTF-8), detected from its first 128 KiB."""
    lines = content[:HEAD].decode(errors="ignore").lstrip("\ufeff").splitlines() or [""]
    delimiter, cells, width = _divided(lines)
    header = _header_row(lines, cells, width)
    if is_number(cells[header][0]):
        return Beginning(delimiter, cells[header], "", header, [], "\n".join(lines[header:]))
    start = header + 1
    # Between header and values there may be lines of units, joints or descriptions, and the header again.
    while start < len(lines) - 1 and _is_text(lines[start], lines[header], cells[start]):
        start += 1
    texts = [k for k in range(start) if len(cells[k]) == width and (k >= header or COMMENT.match(lines[k]))]
    units = {k: [plain_unit(x) for x in cells[k]] for k in texts}
    # A line counts as a line of units only if more than half of its nonempty cells are units: a line of names may also
    # contain a word such as `deg`.
    stated = [k for k, x in units.items() if sum(map(is_unit, x)) > sum(map(bool, x)) / 2]
    stated = stated if len(stated) < len(texts) else []
    below = [k for k in range(header, start) if k not in stated]
    names = _column_names([cells[k] for k in below])
    names = names + [""] * (width - len(names))
    return Beginning(
        delimiter, names, lines[header], start, units[stated[-1]] if stated else [], "\n".join(lines[start:])
    )


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


def _column_names(rows: Sequence[list[str]]) -> list[str]:
    """Return the names of the columns of a CSV file from the cells of its header (rows[0]) and of the next lines.

    The next lines are used only if several columns have the same name in the header. The header then has the
    quantities, each repeated for all joints or only above its first joint, and the next line has the joints: "q" above
    "elbow" gives the name "q_elbow".

    rows: cells of the header and of the lines between the header and the values, without lines of units.
    """
    names = rows[0]
    if len(rows) == 1 or len(set(names)) >= len(names) - 1:
        return names
    filled = names[:1]
    for name in names[1:]:
        filled.append(name or filled[-1])
    columns = zip_longest(filled, *rows[1:], fillvalue="")
    return ["_".join(filter(None, dict.fromkeys(column))) for column in columns]


def _is_text(line: str, header: str, cells: Sequence[str]) -> bool:
    """Return True if a line below the header of a CSV file has no values: units, names, or the header again.

    A line has values if one of its cells is a number, or contains a point, comma or colon between two digits, such as
    "[0.1, 0.2]" and "10:00:00". Names and units with digits, such as "joint1" and "m/s2", are no values.
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


def _in_utf8(content: bytes) -> bytes:
    """Return a text in UTF-8; it may be in UTF-16, in a character set of East Asia or Russia, or in Latin-1."""
    encoding = "utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else ""
    # Without a mark of the byte order, the first character shows UTF-16: its other byte is 0.
    if 0 in content[:2] and content[:2] != b"\0\0":
        encoding = "utf-16-le" if content[1] == 0 else "utf-16-be"
    try:
        # The head of the file may end in the middle of a UTF-8 character, which the incremental decoder omits.
        encoding or codecs.getincrementaldecoder("utf-8")().decode(content[:HEAD], final=len(content) < HEAD)
    except UnicodeDecodeError:
        # Any text can be read as Latin-1: another character set is used if it gives more words of column names.
        heads = {x: content[:HEAD].decode(x, "ignore").lower() for x in CHARACTER_SETS}
        words = [x for x in KNOWN if not x.isascii()]
        encoding = max(heads, key=lambda x: sum(len(word) for word in words if word in heads[x]))
    return content.decode(encoding, "replace").encode() if encoding else content
