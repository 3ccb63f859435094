"""The structure picture in an emitted module's docstring, read back for the report."""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from spelgen.errors import ModuleError

_HEADING = "Mass matrix: "


@dataclass(frozen=True)
class PictureCell:
    """An entry of M: its kind, and the joints it depends on as the module writes them (`2-4,6`, from 1)."""

    kind: Literal["zero", "constant", "varying"]
    joints: str


@dataclass(frozen=True)
class Picture:
    """summary: sentences about the model. rows: the full symmetric matrix."""

    summary: str
    rows: tuple[tuple[PictureCell, ...], ...]


def read_picture(module: Path) -> Picture:
    """The picture in the docstring of the emitted module. Raises ModuleError when there is none."""
    paragraphs = (ast.get_docstring(ast.parse(module.read_bytes())) or "").split("\n\n")
    place = next((k for k, text in enumerate(paragraphs) if text.startswith(_HEADING)), None)
    lower = (
        []
        if place is None
        else [re.split(r" +", line.strip()) for line in paragraphs[place + 1].splitlines()]
    )
    if place is None or [len(row) for row in lower] != list(range(1, len(lower) + 1)):
        raise ModuleError("no picture of the mass matrix in the docstring", file=module, do="build it again")
    cells = {(i, j): _cell(text) for i, row in enumerate(lower) for j, text in enumerate(row)}
    rows = tuple(tuple(cells[max(i, j), min(i, j)] for j in range(len(lower))) for i in range(len(lower)))
    return Picture(" ".join(paragraphs[1].split()), rows)


def _cell(text: str) -> PictureCell:
    if text == "C":
        return PictureCell("constant", "")
    return PictureCell("zero", "") if text == "." else PictureCell("varying", text)
