"""Log files -> tables, one reader for each kind of file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from spelgen.logs.bags import is_bag, read_bag
from spelgen.logs.mapping import PLAIN, LogMapping
from spelgen.logs.npz import read_npz
from spelgen.logs.tables import (
    LogTable,
    labels_among,
    opened,
    read_schema,
    require_columns,
    wanted_names,
    wanted_quantities,
)


def read_tables(file: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """The tables of one file. Raises LogError, where columns are missing too.

    A Parquet file that spelgen itself wrote is read as such, whatever the mapping says.
    """
    if is_bag(file):
        return [_bag(file, joints, mapping)]
    if file.suffix == ".npz":
        return read_npz(file, joints, mapping)
    if file.suffix == ".parquet":
        return [_parquet(file, joints, mapping)]
    table = opened(file, lambda: pa.csv.read_csv(file))
    names = wanted_names(joints, mapping)
    require_columns(table.column_names, names, file, mapping)
    return [LogTable(None, table, names, mapping, labels_among(table.column_names, mapping))]


def _parquet(file: Path, joints: Sequence[str], mapping: LogMapping) -> LogTable:
    schema, mapping = read_schema(file, mapping)
    names, labels = wanted_names(joints, mapping), labels_among(schema.names, mapping)
    require_columns(schema.names, names, file, mapping)
    read = [*names, *filter(None, [labels])]
    return LogTable(
        None, opened(file, lambda: pa.parquet.read_table(file, columns=read)), names, mapping, labels
    )


def _bag(file: Path, joints: Sequence[str], mapping: LogMapping) -> LogTable:
    table = read_bag(file, [mapping.log_name(joint) for joint in joints], mapping.topic)
    plain = {x: PLAIN[x].replace("{joint}", "{}") for x in wanted_quantities(mapping)}
    names = [form.format(mapping.log_name(joint)) for form in plain.values() for joint in joints]
    require_columns(table.column_names, ["t", *names], file, LogMapping())
    return LogTable(None, table, ("t", *names), mapping)
