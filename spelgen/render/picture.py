"""The structure picture in an emitted module's docstring, read back for the report."""

from __future__ import annotations

import ast
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from spelgen.errors import ModuleError

HEADING = "Mass matrix: "
KINDS = {"C": "constant", ".": "zero"}


@dataclass(frozen=True)
class PictureCell:
    """An entry of M: zero, constant or varying, and the joints it depends on as the module has them (`2-4,6`)."""

    kind: str
    joints: str


@dataclass(frozen=True)
class Picture:
    """summary: sentences about the model. rows: the full symmetric matrix."""

    summary: str
    rows: list[list[PictureCell]]

    @property
    def kinds(self) -> list[list[str]]:
        """Return the kind of each entry."""
        kinds = []
        for row in self.rows:
            kinds.append([cell.kind for cell in row])
        return kinds


def read_picture(module: Path) -> Picture:
    """Return the picture in the docstring of the emitted module. Raises ModuleError when there is none."""
    paragraphs = (ast.get_docstring(ast.parse(module.read_bytes())) or "").split("\n\n")
    lower: list[list[str]] = []
    for heading, text in pairwise(paragraphs):
        if heading.startswith(HEADING):
            lower = [line.split() for line in text.splitlines()]
            break
    if not lower or [len(row) for row in lower] != list(range(1, len(lower) + 1)):
        raise ModuleError("no picture of the mass matrix in the docstring", file=module, do="build it again")
    rows = []
    for i in range(len(lower)):
        rows.append([_cell(lower[max(i, j)][min(i, j)]) for j in range(len(lower))])
    return Picture(" ".join(paragraphs[1].split()), rows)


def _cell(text: str) -> PictureCell:
    if text in KINDS:
        return PictureCell(KINDS[text], "")
    return PictureCell("varying", text)
