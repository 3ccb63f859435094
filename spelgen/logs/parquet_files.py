"""Read Parquet logs: the columns that are asked for, and no others."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet

from spelgen.logs.tables import LogFormat, LogTable, reading, stored_columns, table_layout
from spelgen.settings.log_mapping import LogMapping


def read_parquet(file: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """Return the one table of a file. A file that spelgen wrote is read as such, whatever the mapping says."""
    with reading(file):
        schema = pa.parquet.read_schema(file)
    layout = table_layout(schema, joints, mapping, file)
    with reading(file):
        table = pa.parquet.read_table(file, columns=stored_columns(layout, schema.names))
    return [LogTable(None, table, layout)]


def parquet_columns(file: Path) -> pa.Table:
    """Return all columns of a file."""
    with reading(file):
        return pa.parquet.read_table(file)


PARQUET = LogFormat(read_parquet, suffixes=(".parquet",), columns=parquet_columns)
