"""Read CSV logs as spreadsheets and loggers write them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.csv

from spelgen.logs.tables import LogFormat, LogTable, reading, table_layout
from spelgen.settings.log_mapping import LogMapping

HEAD = 2**16  # bytes from which encoding, delimiter and decimal point are detected


def read_csv(file: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """Return the one table of a file."""
    table = csv_columns(file)
    return [LogTable(None, table, table_layout(table.schema, joints, mapping, file))]


def csv_columns(file: Path) -> pa.Table:
    """Return a table of commas, semicolons or tabs, with decimal commas beside the latter two.

    Text may be UTF-8, UTF-16 or Latin-1.
    """
    with reading(file):
        encoding, head = _decoded_head(file)
        names, _, rows = head.partition("\n")
        delimiter = max(",;\t", key=names.count)
        decimal_point = "."
        if delimiter != "," and re.search(rf"(^|{delimiter}) *-?\d+,\d", rows, re.MULTILINE):
            decimal_point = ","
        table = pa.csv.read_csv(
            file,
            pa.csv.ReadOptions(encoding=encoding),
            pa.csv.ParseOptions(delimiter=delimiter),
            pa.csv.ConvertOptions(decimal_point=decimal_point),
        )
    return table.rename_columns([name.strip() for name in table.column_names])


def _decoded_head(file: Path) -> tuple[str, str]:
    """Return the encoding and the first characters of a file."""
    with file.open("rb") as source:
        head = source.read(HEAD)
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16", head.decode("utf-16", "ignore")
    # a head cut off in the middle of a character is still UTF-8
    errors = "strict" if len(head) < HEAD else "ignore"
    try:
        return "utf-8", head.decode("utf-8", errors)
    except UnicodeDecodeError:
        return "latin-1", head.decode("latin-1")


CSV = LogFormat(read_csv, suffixes=(".csv",), columns=csv_columns)
