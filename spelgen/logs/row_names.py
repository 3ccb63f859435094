"""Names of joints in the rows of a log, as in messages of ROS: a list or several cells, which may differ per row."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TypeAlias

import pyarrow as pa
import pyarrow.compute

from spelgen.errors import LogError

RowsByNames: TypeAlias = dict[tuple[str, ...], pa.ChunkedArray]
"""{list of names: mask (T,) of the rows with this list}. Indices of a mapping refer to the first list."""
# A text that is the name of a joint, and no number.
NAME = re.compile(r"[^\W\d][\w/.:-]*")
# The number at the end of a column's name.
NUMBER = re.compile(r"\d+$")


def first_list(column: pa.ChunkedArray) -> list[str]:
    """Return the first list of a column of lists, which may be texts such as "[0.1, 0.2]"; [] for other columns."""
    return _list_of(next(iter(column.drop_null().slice(0, 1).to_pylist()), None))


def _list_of(cell: object) -> list[str]:
    """Return the list in a cell of a table; [] for a cell that is neither a list nor its text."""
    if isinstance(cell, str) and (match := re.fullmatch(r"[^\[({]*[\[({]+(.*?)[\])}]+", cell.strip())):
        return [text.strip("'\"") for text in re.split(r"[,;\s]+", match[1].strip())]
    return cell if isinstance(cell, list) else []


def are_names(field: pa.Field) -> bool:
    """Return True for a column that may contain joint names: lists of texts, or texts in a numbered column."""
    if pa.types.is_string(field.type):
        return bool(NUMBER.search(field.name))
    return _is_list_of_texts(field.type)


def _is_list_of_texts(values: pa.DataType) -> bool:
    return bool(pa.types.is_list(values) and pa.types.is_string(values.value_type))


def rows_by_names(table: pa.Table, names: Mapping[str, str], file: Path) -> RowsByNames:
    """Return {list of joint names: mask of the rows with this list}; {} if all rows of a table have the same list.

    The first list is the first one in the table that contains all joints of the arm, or else the list of the first row.
    A LogError is raised if the rows are of several arms: no list contains all joints of the arm, and some list with at
    least as many names shares no name with the list of the first row. names: {joint: its name in the log}.
    """
    lengths = [len(first_list(column)) for column in table.columns]
    for column in table.columns:
        if _is_list_of_texts(column.type):
            column = pa.compute.binary_join_element_wise("[", pa.compute.binary_join(column, ","), "]", "")
        first = first_list(column)
        if not (first and pa.types.is_string(column.type) and all(map(NAME.fullmatch, first))):
            continue
        # lists of names that belong to no list of values, such as tags, are no names of joints
        if lengths.count(len(first)) < 2:
            continue
        lists = {text: tuple(_list_of(text)) for text in column.unique().drop_null().to_pylist()}
        of_arm = [x for x in lists.values() if set(names.values()) <= set(x)]
        other_arms = [x for x in lists.values() if len(x) >= len(names) and set(x).isdisjoint(first)]
        if other_arms and not of_arm:
            raise LogError(
                f"joint states of {', '.join(first)} and of {', '.join(other_arms[0])}", file=file,
                expected=", ".join(names.values()), do="write each joint's name as 'name' under 'logs', 'joints'",
            )  # fmt: skip
        if len(lists) > 1:
            ordered = sorted(lists, key=lambda text: lists[text] not in of_arm[:1])
            return {lists[text]: pa.compute.equal(column, text) for text in ordered}
    return {}


def sorted_by_names(table: pa.Table, columns: Mapping[str, str]) -> pa.Table:
    """Return a table in which each column contains the values of one joint in all rows, by the names in the rows.

    The names of joints are in cells of columns such as `name0`, `name1`, ...: the value in the column `q1` is of the
    joint with the name in `name1`. Values become null in rows without the name of the joint. A table without columns
    of joint names is unchanged.

    columns: {column: name of its joint in the log}, such as {"q0": "elbow"}.
    """
    stems: dict[str, dict[str, pa.ChunkedArray]] = {}
    for column, texts in zip(table.column_names, table.columns, strict=True):
        if pa.types.is_string(texts.type) and (number := NUMBER.search(column)):
            stems.setdefault(column[: number.start()], {})[number[0]] = texts
    # `names`: {number in the name of a column, such as "0": joint names (T,) in the rows}. The columns of another
    # stem, such as `mode0`, do not contain the names of all joints.
    names: dict[str, pa.ChunkedArray] = {}
    for numbered in stems.values():
        logged = {text for texts in numbered.values() for text in texts.unique().to_pylist()}
        names = numbered if logged.issuperset(columns.values()) else names
    result = table
    for column, joint in columns.items():
        number = NUMBER.search(column)
        if not number or number[0] not in names or column not in table.column_names:
            continue
        values = pa.nulls(len(table))
        for other, name in names.items():
            source = column[: number.start()] + other
            if table.column_names.count(source) == 1:
                values = pa.compute.if_else(pa.compute.equal(name, joint), table[source], values)
        result = result.set_column(table.column_names.index(column), column, values)
    return result
