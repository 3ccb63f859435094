"""Lay out tables as text and as HTML: the same rows for a terminal, a file, a page and a notebook.

Rich lays them out. Its console is told all that it would else ask the terminal and the environment for (width,
colours, notebook), so that the same rows give the same text wherever they go.
"""

from __future__ import annotations

import io
import math
import re
import textwrap
from dataclasses import dataclass, replace
from html import escape
from typing import Literal

WIDTH = 80
SHORTEST = 8
"""Characters of a name in one line; a longer name goes on in the next where a table would be too wide."""
HEAD = 14
"""The same of a column's name."""
SEPARATOR = re.compile(r"(?<=[_\-/. ])(?<!\d\.)(?!s\))")  # after it a name may go on in the next line


@dataclass(frozen=True)
class Listing:
    """Hold a table with a name in the first column; the columns in `left` are aligned to the left, others to the right.

    text(): a title, the head and the rows, indented by two, then the note, wrapped. Where a table does not fit 80
    columns its names are folded, numbers never are; and it is cut, where words would be. html(): the same for
    notebooks; all text is escaped.
    """

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""
    left: tuple[int, ...] = (0,)

    def text(self) -> str:
        """Return the table for a terminal or a file, without a line end."""
        tables = "\n\n".join(table._layout() for table in self._cut())
        note = textwrap.wrap(self.note, WIDTH - 2, initial_indent="  ", subsequent_indent="  ")
        return "\n".join([*textwrap.wrap(self.title, WIDTH), tables, *note])

    def html(self) -> str:
        """Return the table for a notebook."""
        lines = []
        if self.title:
            lines.append(f"<p><b>{escape(self.title)}</b></p>")
        lines += ["<table><thead>", self._html_row(self.head, "th"), "</thead><tbody>"]
        for row in self.rows:
            lines.append(self._html_row(row, "td"))
        lines.append("</tbody></table>")
        if self.note:
            lines.append(f"<p>{escape(self.note)}</p>")
        return "".join(lines)

    def _html_row(self, cells: tuple[str, ...], tag: str) -> str:
        text = ""
        for column, cell in enumerate(cells):
            text += f'<{tag} style="text-align: {self._side(column)}">{escape(cell)}</{tag}>'
        return f"<tr>{text}</tr>"

    def _side(self, column: int) -> Literal["left", "right"]:
        if column in self.left:
            return "left"
        return "right"

    def _head(self) -> list[str]:
        """Return the head, its names folded where the table would be too wide."""
        widths = [0] * len(self.head)
        for row in self.rows:
            widths = [max(width, _wide(cell)) for width, cell in zip(widths, row, strict=True)]
        total = 0
        folded = [self.head[0]]
        for name, width in zip(self.head, widths, strict=True):
            total += 2 + max(_wide(name), width)
        if total <= WIDTH:
            return list(self.head)
        for name, width in zip(self.head[1:], widths[1:], strict=True):
            folded.append(_folded(name, max(HEAD, width)))
        return folded

    def _widths(self) -> list[int]:
        """Return the widths of the columns under that head."""
        widths = []
        for column in zip(self._head(), *self.rows, strict=True):
            lines = "\n".join(column).split("\n")
            widths.append(max(map(_wide, lines)))
        return widths

    def _cut(self) -> list[Listing]:
        """Return the same columns in as many tables as leave room for the words in the names of rows."""
        longest_word = SHORTEST
        for row in self.rows:
            longest_word = max(longest_word, *map(_wide, SEPARATOR.split(row[0])))
        room = WIDTH - 2 - longest_word
        groups: list[list[int]] = [[]]
        used = 0
        for column, width in enumerate(self._widths()):
            if column == 0:
                continue
            if groups[-1] and used + 2 + width > room:
                groups.append([])
                used = 0
            groups[-1].append(column)
            used += 2 + width
        return [self._columns([0, *group]) for group in groups]

    def _columns(self, columns: list[int]) -> Listing:
        """Return the table of these columns alone."""
        rows = []
        for row in self.rows:
            rows.append(tuple(row[column] for column in columns))
        head = tuple(self.head[column] for column in columns)
        left = tuple(columns.index(column) for column in self.left if column in columns)
        return replace(self, head=head, rows=tuple(rows), left=left)

    def _layout(self) -> str:
        from rich.console import Console  # here: `--help` and `import spelgen` stay fast
        from rich.table import Table
        from rich.text import Text

        widths = self._widths()
        room = max(SHORTEST, WIDTH - 2 * len(widths) - sum(widths[1:]))
        widths[0] = min(widths[0], SHORTEST)  # names may be folded, numbers never are
        table = Table(box=None, show_header=False, padding=(0, 0, 0, 2))
        for column, width in enumerate(widths):
            table.add_column(justify=self._side(column), overflow="fold", min_width=width, no_wrap=column > 0)
        for name, *cells in (self._head(), *self.rows):
            table.add_row(Text(_folded(name, room)), *map(Text, cells))
        file = io.StringIO()
        width = max(WIDTH, sum(widths) + 2 * len(widths))
        console = Console(
            file=file,
            width=width,
            color_system=None,
            force_terminal=False,
            force_jupyter=False,
            legacy_windows=False,
            _environ={},
        )
        console.print(table, crop=False)
        lines = [line.rstrip() for line in file.getvalue().rstrip("\n").split("\n")]
        return "\n".join(lines)


def _wide(text: str) -> int:
    """Return the characters of a terminal that a text takes."""
    from rich.cells import cell_len

    return cell_len(text)


def _folded(name: str, width: int) -> str:
    """Return the name with line breaks after its separators where it is longer than the width."""
    lines = [""]
    for word in SEPARATOR.split(name):
        if lines[-1] and len(lines[-1]) + len(word) > width:
            lines.append("")
        lines[-1] += word
    return "\n".join(lines)


def number(value: float | None) -> str:
    """Return three significant digits, whole numbers from 1000 on; a dash for None and for what is not finite."""
    if value is None or not math.isfinite(value):
        return "-"
    if value == 0 or 1e-3 <= abs(value) < 1e3:
        return f"{value:.3g}"
    if 1e3 <= abs(value) < 1e6:
        return f"{value:.0f}"
    return f"{value:.2e}"
