"""Tables as text and as HTML: for a terminal, a file, a page and a notebook."""

import math
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import zip_longest
from typing import Literal, Self

WIDTH = 80
MIN_NAME = 8
"""Smallest width of the first column [characters], to which names of rows are wrapped if a table is too wide."""
# Matches places between words at which names of rows may be wrapped, but not before the last s of a unit, as in [Nm s].
BLANK = re.compile(r"(?<= )(?!s[)\]])")
# Matches also places within words: after "_", "-", "/" and ".", but not after the point of a number, as in 1.5, and not
# before the last s of a unit, as in [rad/s].
SEPARATOR = re.compile(r"(?<=[_\-/. ])(?<!\d\.)(?!s[)\]])")


@dataclass(frozen=True)
class Listing:
    """A table with a name in the first column; the columns in `left` are aligned to the left, others to the right.

    text() returns the title, the head and the rows, indented by two blanks, then the note. In a table wider than 80
    characters, names are wrapped, not numbers; if the table is still too wide, it is split into several tables.
    html() returns the table for notebooks, with escaped text.
    """

    title: str
    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    note: str = ""
    left: tuple[int, ...] = (0,)

    @classmethod
    def of_columns(cls, title: str, columns: Mapping[str, Iterable[str]], note: str) -> Self:
        """Return a table of columns: {head: cells}; the first column has the names of the rows."""
        return cls(title, tuple(columns), list(zip(*columns.values(), strict=True)), note)

    def text(self) -> str:
        """Return the table as text for a terminal or a file, without a final line end."""
        columns = list(map(list, zip(self.head, *self.rows, strict=True)))
        tables = "\n\n".join(self._layout(columns, group) for group in _groups(_fitted(columns)))
        # The note below a table is indented like the rows, so that titles, which are not indented, are easy to find.
        note = textwrap.wrap(self.note, WIDTH - 2, initial_indent="  ", subsequent_indent="  ")
        return "\n".join([*textwrap.wrap(self.title, WIDTH), tables, *note])

    def html(self) -> str:
        """Return the table as HTML for a notebook."""
        title = f"<p><b>{escape(self.title)}</b></p>" if self.title else ""
        note = f"<p>{escape(self.note)}</p>" if self.note else ""
        rows = "".join(self._html_row(row, "td") for row in self.rows)
        head = f"<thead>{self._html_row(self.head, 'th')}</thead>"
        return f"{title}<table>{head}<tbody>{rows}</tbody></table>{note}"

    def _html_row(self, cells: tuple[str, ...], tag: str) -> str:
        text = ""
        for column, cell in enumerate(cells):
            text += f'<{tag} style="text-align: {self._side(column)}">{escape(cell)}</{tag}>'
        return f"<tr>{text}</tr>"

    def _side(self, column: int) -> Literal["left", "right"]:
        return "left" if column in self.left else "right"

    def _layout(self, columns: Sequence[Sequence[str]], group: Sequence[int]) -> str:
        """Return the text of a table with the first column (names of rows) and the columns with indices `group`."""
        names, *chosen = _fitted([columns[column] for column in (0, *group)])
        room = WIDTH - 2 * (1 + len(group)) - sum(map(_width, chosen))
        chosen.insert(0, [re.sub(r" +$", "", _folded(x, max(MIN_NAME, room)), flags=re.M) for x in names])
        lines = []
        for row in zip(*chosen, strict=True):
            for cells in zip_longest(*(cell.split("\n") for cell in row), fillvalue=""):
                line = ""
                for side, column, cell in zip(map(self._side, (0, *group)), chosen, cells, strict=True):
                    blanks = " " * (_width(column) - _width([cell]))
                    line += f"  {cell}{blanks}" if side == "left" else f"  {blanks}{cell}"
                lines.append(line.rstrip())
        return "\n".join(lines)


def _fitted(columns: Sequence[Sequence[str]]) -> list[Sequence[str]]:
    """Return the columns of a table, each a list of its head and cells; heads are wrapped if the table is too wide."""
    if sum(2 + _width(column) for column in columns) <= WIDTH:
        return list(columns)
    # Heads of columns are wrapped to at least 14 characters: in narrower heads most words would be cut.
    return [columns[0], *([_folded(head, max(14, _width(cells))), *cells] for head, *cells in columns[1:])]


def _groups(columns: Sequence[Sequence[str]]) -> list[list[int]]:
    """Return groups of column indices: the columns of one group, next to the names of rows, fit into the page width.

    columns: texts of each column; column 0 has the names of the rows and is in no group.
    """
    # Each group becomes a table of its own, below the previous one. Narrow names of rows permit more columns per table.
    # Three forms of the names are therefore tried: not wrapped, wrapped between words, and wrapped within words. The
    # first form with the smallest number of groups is used.
    names = columns[0][1:]
    forms = (
        names,
        *([word.rstrip() for x in names for word in separator.split(x)] for separator in (BLANK, SEPARATOR)),
    )
    return min((_packed(columns, WIDTH - 2 - max(MIN_NAME, _width(words))) for words in forms), key=len)


def _packed(columns: Sequence[Sequence[str]], room: int) -> list[list[int]]:
    """Return groups of column indices, in their order, so that the columns of one group have at most the width `room`.

    columns, result: see `_groups`.
    """
    groups: list[list[int]] = [[]]
    used = 0
    # Columns are assigned greedily to tables: their order is preserved, and only the last table may be narrow.
    for column in range(1, len(columns)):
        width = 2 + _width(columns[column])
        if used and used + width > room:
            groups.append([])
            used = 0
        groups[-1].append(column)
        used += width
    return groups


def _width(texts: Iterable[str]) -> int:
    """Return the width of the widest line in characters of a terminal."""
    from rich.cells import cell_len  # rich is imported here: its import is slow

    return max((cell_len(line) for text in texts for line in text.split("\n")), default=0)


def _folded(name: str, width: int) -> str:
    """Return a name with line breaks after separators if it is longer than `width` characters."""
    lines = [""]
    for word in SEPARATOR.split(name):
        if lines[-1] and len(lines[-1]) + len(word.rstrip()) > width:
            lines.append("")
        lines[-1] += word
    return "\n".join(lines)


def number(value: float | None) -> str:
    """Return a float with three significant digits, or as an integer from 1000 on; an int with all its digits.

    None and numbers that are not finite become a dash.
    """
    if value is None or not math.isfinite(value):
        return "-"
    # Integers are counts, of samples for example: rounding would hide a lost sample.
    if isinstance(value, int):
        return f"{value:,}"
    # Numbers from 0.001 to 1,000 are written without an exponent.
    if value == 0 or 1e-3 <= abs(value) < 1e3:
        return f"{value:.3g}"
    if 1e3 <= abs(value) < 1e6:
        return f"{value:.0f}"
    return f"{value:.2e}"


def duration(seconds: float) -> str:
    """Return a duration, given in seconds, as text such as `40 s`, `2.5 min` or `3.5 h`."""
    # Times have at most three digits: durations of repeated trainings differ by more than the rounding.
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = seconds / 60
    return f"{minutes:.1f} min" if minutes < 100 else f"{minutes / 60:.1f} h"
