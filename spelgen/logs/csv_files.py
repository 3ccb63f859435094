"""Read CSV logs as spreadsheets and loggers write them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.csv

from spelgen.errors import LogError
from spelgen.logs.tables import LogFormat, LogTable, table_layout
from spelgen.logs.values import is_number
from spelgen.settings.log_mapping import LogMapping
from spelgen.settings.tuning.logs import TUNING


def read_csv(file: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """Return the one table of a file."""
    table = csv_columns(file)
    return [(table_layout(table.schema, joints, mapping, file), table)]


def csv_columns(file: Path) -> pa.Table:
    """Return a table of commas, semicolons or tabs, with decimal commas beside the latter two.

    Text may be UTF-8, UTF-16 or Latin-1.
    """
    encoding, head = _decoded_head(file)
    names, _, rows = head.partition("\n")
    delimiter = max(",;\t", key=names.count)
    cells = names.split(delimiter)
    if is_number(cells[0]):
        raise LogError(
            f"numbers in the first line ({', '.join(cells[:3])}, ...)", file=file, line=1,
            expected="a header: the names of the columns",
            do="write one, t,q_<joint>,...,qd_<joint>,...,tau_<joint>,... for example",
        )  # fmt: skip
    decimal_commas = delimiter != "," and re.search(rf"(^|{delimiter}) *-?\d+,\d", rows, re.MULTILINE)
    table = pa.csv.read_csv(
        file,
        pa.csv.ReadOptions(encoding=encoding),
        pa.csv.ParseOptions(delimiter=delimiter),
        pa.csv.ConvertOptions(decimal_point="," if decimal_commas else "."),
    )
    return table.rename_columns([name.strip() for name in table.column_names])


def _decoded_head(file: Path) -> tuple[str, str]:
    """Return the encoding and the first characters of a file."""
    with file.open("rb") as source:
        head = source.read(TUNING.csv_head)
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16", head.decode("utf-16", "ignore")
    # a head cut off in the middle of a character is still UTF-8
    errors = "strict" if len(head) < TUNING.csv_head else "ignore"
    try:
        return "utf-8", head.decode("utf-8", errors)
    except UnicodeDecodeError:
        return "latin-1", head.decode("latin-1")


CSV = LogFormat(read_csv, suffixes=(".csv",), columns=csv_columns)
