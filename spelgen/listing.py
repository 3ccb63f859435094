"""Tables of text: the same for a terminal and for a page."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass

WIDTH = 80
LEAST = 8  # characters of a name are always shown


@dataclass(frozen=True)
class Listing:
    """A table with a name in the first column and text aligned to the right in all others."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def text(self) -> str:
        """For a terminal."""
        lines = [self.head, *self.rows]
        widths = [max(len(line[k]) for line in lines) for k in range(len(self.head))]
        widths[0] = min(widths[0], max(LEAST, WIDTH - 2 - sum(2 + width for width in widths[1:])))
        lines = [(_shortened(line[0], widths[0]), *line[1:]) for line in lines]
        laid = [
            f"  {line[0]:<{widths[0]}}"
            + "".join(f"  {x:>{w}}" for x, w in zip(line[1:], widths[1:], strict=True))
            for line in lines
        ]
        told = textwrap.wrap(self.note, WIDTH - 2, initial_indent="  ", subsequent_indent="  ")
        return "\n".join([self.title, *(line.rstrip() for line in laid), *told])


def _shortened(name: str, width: int) -> str:
    return name if len(name) <= width else f"{name[: width - 3]}..."
