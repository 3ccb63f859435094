"""Constant arrays of C."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from textwrap import wrap

import numpy as np

_WIDTH = 112


@dataclass(frozen=True)
class Table:
    """A constant array; ``name`` with its dimensions, in brackets."""

    type: str
    name: str
    rows: str


def table(name: str, values: np.ndarray) -> Table:
    """Numbers with all their digits; of a matrix, rows of as many as it has columns."""
    if values.ndim == 1:
        return Table("real", f"{name}[]", _wrapped(repr(float(x)) for x in values))
    rows = (f"    {{{', '.join(repr(float(x)) for x in row)}}}" for row in values)
    return Table("real", f"{name}[][{values.shape[1]}]", ",\n".join(rows))


def integer_table(name: str, values: Sequence[int]) -> Table:
    """Whole numbers."""
    return Table("short", f"{name}[]", _wrapped(map(str, values)))


def _wrapped(texts: Iterable[str]) -> str:
    return "\n".join(wrap(", ".join(texts), _WIDTH, initial_indent="    ", subsequent_indent="    "))
