"""Find columns of a table, and turn them into numbers as they were logged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute

from spelgen.errors import LogError
from spelgen.logs.tables import list_element


def column(table: pa.Table | pa.RecordBatch, name: str) -> pa.ChunkedArray | pa.Array:
    """Return a column, or of a name like `position[2]` that element of each of its lists, written as text maybe."""
    element = list_element(name, table.schema.names)
    if element is None:
        return table.column(name)
    lists, index = table.column(element[0]), element[1]
    is_text = not pa.types.is_nested(lists.type)
    if is_text:
        bare = pa.compute.replace_substring_regex(lists.cast(pa.string()), r"^.*[\[(]\s*|\s*[\])].*$", "")
        lists = pa.compute.split_pattern_regex(bare, r"[,;\s]+")
    # Arrow raises for an index beyond a list, where a missing number is what it means
    long_enough = pa.compute.greater(pa.compute.list_value_length(lists), index)
    lists = pa.compute.if_else(long_enough, lists, pa.scalar(None, lists.type))
    elements = pa.compute.list_element(lists, index)
    return pa.compute.replace_substring_regex(elements, "^$", "nan") if is_text else elements


def floats(values: pa.ChunkedArray | pa.Array, column: str, file: Path, row: int) -> np.ndarray:
    """Return a column as float64 (T,)."""
    try:
        floats: np.ndarray = values.cast(pa.float64()).to_numpy(zero_copy_only=False)
        return floats
    except (pa.ArrowException, ValueError) as error:
        # Arrow does not say which row
        if pa.types.is_string(values.type):
            for index, text in enumerate(values.to_pylist()):
                if text and not is_number(text):
                    raise LogError(
                        repr(text[:60]), file=file, line=line_of(file, row + index),
                        element=f"row {row + index + 1}, column {column}", expected="a number",
                    ) from error  # fmt: skip
        got = f"values of type {values.type}"
        raise LogError(got, file=file, element=f"column {column}", expected="numbers") from error


def is_number(text: str) -> bool:
    """Whether a text is a number, as Python writes it."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def line_of(file: Path, row: int) -> int | None:
    """Return the line of a 0-based data row, where the format has lines (a CSV's first is its header)."""
    return int(row) + 2 if file.suffix == ".csv" else None
