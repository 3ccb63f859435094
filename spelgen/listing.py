"""Tables of text and of HTML: the same rows for a terminal, a file, a page and a notebook.

Rich lays them out. Its console is told all that it would else ask the terminal and the environment for (width,
colours, notebook), so that the same rows give the same text wherever they go.
"""

from __future__ import annotations

import io
import re
import textwrap
from dataclasses import dataclass, replace
from html import escape
from typing import Literal

WIDTH = 80
SHORTEST = (
    8  # characters of a name in one line; a longer name goes on in the next where a table would be too wide
)
HEAD = 14  # likewise of a column's name
SEPARATOR = re.compile(r"(?<=[_\-/. ])(?<!\d\.)(?!s\))")  # after it a name may go on in the next line


@dataclass(frozen=True)
class Listing:
    """A table with a name in the first column; the columns in `left` are aligned to the left, others to the right.

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
        """For a terminal or a file, without a line end."""
        note = textwrap.wrap(self.note, WIDTH - 2, initial_indent="  ", subsequent_indent="  ")
        lines = "\n\n".join("\n".join(part._lines()) for part in self._parts())
        return "\n".join([*textwrap.wrap(self.title, WIDTH), lines, *note])

    def html(self) -> str:
        """For a notebook."""
        title = f"<p><b>{escape(self.title)}</b></p>" if self.title else ""
        note = f"<p>{escape(self.note)}</p>" if self.note else ""
        rows = "".join(self._row(row, "td") for row in self.rows)
        return f"{title}<table><thead>{self._row(self.head, 'th')}</thead><tbody>{rows}</tbody></table>{note}"

    def _head(self) -> tuple[str, ...]:
        """The head, its names folded where the table would be too wide."""
        needed = [max((_wide(row[k]) for row in self.rows), default=0) for k in range(len(self.head))]
        if sum(2 + max(_wide(name), width) for name, width in zip(self.head, needed, strict=True)) <= WIDTH:
            return self.head
        folded = (_folded(x, max(HEAD, width)) for x, width in zip(self.head[1:], needed[1:], strict=True))
        return (self.head[0], *folded)

    def _widths(self) -> list[int]:
        """Of the columns under that head."""
        columns = zip(self._head(), *self.rows, strict=True)
        return [max(_wide(line) for cell in column for line in cell.split("\n")) for column in columns]

    def _parts(self) -> list[Listing]:
        """The same columns in as many tables as it takes to leave room for the words in the names of rows."""
        widths = [2 + width for width in self._widths()]
        words = (_wide(word) for row in self.rows for word in SEPARATOR.split(row[0]))
        most = WIDTH - 2 - max(SHORTEST, *words, 0)
        if sum(widths[1:]) <= most or len(widths) == 2:
            return [self]
        parts: list[list[int]] = [[]]
        for k in range(1, len(widths)):
            if parts[-1] and sum(widths[j] for j in (*parts[-1], k)) > most:
                parts.append([])
            parts[-1].append(k)
        return [
            replace(
                self, head=(self.head[0], *(self.head[k] for k in part)),
                rows=tuple((row[0], *(row[k] for k in part)) for row in self.rows),
                left=tuple(j + 1 for j, k in enumerate(part) if k in self.left) + ((0,) if 0 in self.left else ()),
            )
            for part in parts
        ]  # fmt: skip

    def _row(self, cells: tuple[str, ...], tag: str) -> str:
        sides = ["left" if k in self.left else "right" for k in range(len(cells))]
        text = "".join(
            f'<{tag} style="text-align: {side}">{escape(cell)}</{tag}>'
            for side, cell in zip(sides, cells, strict=True)
        )
        return f"<tr>{text}</tr>"

    def _lines(self) -> list[str]:
        from rich.console import Console  # here: `--help` and `import spelgen` stay fast
        from rich.table import Table
        from rich.text import Text

        head, widths = self._head(), self._widths()
        lines = [head, *self.rows]
        widths[0] = min(widths[0], SHORTEST)
        table = Table(box=None, show_header=False, padding=(0, 0, 0, 2))
        for k, width in enumerate(widths):
            side: Literal["left", "right"] = "left" if k in self.left else "right"
            table.add_column(justify=side, overflow="fold", min_width=width, no_wrap=k > 0)
        room = max(SHORTEST, WIDTH - sum(2 + width for width in widths[1:]) - 2)
        for line in lines:
            table.add_row(*map(Text, (_folded(line[0], room), *line[1:])))
        file = io.StringIO()
        console = Console(
            file=file, width=max(WIDTH, sum(widths) + 2 * len(widths)), color_system=None, force_terminal=False,
            force_jupyter=False, legacy_windows=False, _environ={},
        )  # fmt: skip
        console.print(table, crop=False)
        return [line.rstrip() for line in file.getvalue().rstrip("\n").split("\n")]


def _wide(text: str) -> int:
    """The characters of a terminal that a text takes."""
    from rich.cells import cell_len

    return cell_len(text)


def _folded(name: str, width: int) -> str:
    """The name with line breaks after its separators where it is longer than the width."""
    lines = [""]
    for part in SEPARATOR.split(name):
        if lines[-1] and len(lines[-1]) + len(part) > width:
            lines.append("")
        lines[-1] += part
    return "\n".join(lines)


def number(value: float | None) -> str:
    """Three significant digits; a dash for what is not known."""
    if value is None:
        return "-"
    return f"{value:.3g}" if value == 0 or 1e-3 <= abs(value) < 1e4 else f"{value:.2e}"
