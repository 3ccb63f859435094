"""Log files -> tables, one reader for each kind of file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from spelgen.logs.bags import is_bag, read_bag
from spelgen.logs.lerobot import dataset_files, dataset_mapping, is_dataset
from spelgen.logs.npz import read_npz
from spelgen.logs.tables import LogTable, made_layout, opened, stored_columns, table_layout, wanted_quantities
from spelgen.settings.log_mapping import PLAIN, LogMapping

HEAD = 2**16  # bytes of a CSV file that tell how it is written


def read_tables(file: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """The tables of one file. Raises LogError, where columns are missing too.

    A Parquet file that spelgen itself wrote is read as such, whatever the mapping says.
    """
    if is_dataset(file):
        mapping = dataset_mapping(file, joints, mapping)
        return [each for part in dataset_files(file) for each in read_tables(part, joints, mapping)]
    if is_bag(file):
        return [_bag(file, joints, mapping)]
    if file.suffix == ".npz":
        return read_npz(file, joints, mapping)
    if file.suffix == ".parquet":
        schema = opened(file, lambda: pa.parquet.read_schema(file))
        layout = table_layout(schema, joints, mapping, file)
        stored = stored_columns(layout, schema.names)
        return [LogTable(None, opened(file, lambda: pa.parquet.read_table(file, columns=stored)), layout)]
    table = opened(file, lambda: read_csv(file))
    return [LogTable(None, table, table_layout(table.schema, joints, mapping, file))]


def read_csv(file: Path) -> pa.Table:
    """A table of commas, semicolons or tabs, with decimal commas beside the latter two, in UTF-8, -16 or Latin-1."""
    with file.open("rb") as source:
        head = source.read(HEAD)
    encoding = "utf-16" if head[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8"
    try:
        names, _, rows = head.decode(encoding, "strict" if len(head) < HEAD else "ignore").partition("\n")
    except UnicodeDecodeError:
        encoding = "latin-1"
        names, _, rows = head.decode(encoding).partition("\n")
    delimiter = max(",;\t", key=names.count)
    decimal = (
        "," if delimiter != "," and re.search(rf"(^|{delimiter}) *-?\d+,\d", rows, re.MULTILINE) else "."
    )
    table = pa.csv.read_csv(
        file,
        pa.csv.ReadOptions(encoding=encoding),
        pa.csv.ParseOptions(delimiter=delimiter),
        pa.csv.ConvertOptions(decimal_point=decimal),
    )
    return table.rename_columns([name.strip() for name in table.column_names])


def _bag(file: Path, joints: Sequence[str], mapping: LogMapping) -> LogTable:
    names = [mapping.log_name(joint) for joint in joints]
    table = read_bag(file, names, mapping.topic)
    plain = LogMapping(velocity=mapping.velocity)
    table_layout(table.schema, names, plain, file)
    columns = [PLAIN[x].replace("{joint}", name) for x in wanted_quantities(mapping) for name in names]
    return LogTable(None, table, made_layout(["t", *columns], None, joints, mapping))
