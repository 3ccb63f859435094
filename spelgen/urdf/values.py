"""Checked values of URDF attributes, and the list of defects of a file.

The package yourdfpy is not used: each number is checked as text first (count, length, finiteness, line), and yourdfpy
replaces absent inertias by 1.0, converts origins to matrices and drops mechanical reductions. Tests compare the two
readings of all other values.
"""

from __future__ import annotations

import re
from math import isfinite
from pathlib import Path

from lxml import etree

from spelgen.errors import Diagnostic, UrdfError
from spelgen.urdf.robot import Vector

# Largest magnitude of a number of exact geometry: products of a few such numbers are in the range of a float.
MAX_MAGNITUDE = 1e12
MAX_NUMBER_TEXT = 64
# [rad, m; Nm, N; per second] From these on a limit states that there is none: exporters write 1e9, 1e16 or DBL_MAX.
UNLIMITED = {"lower": 1e3, "upper": 1e3, "effort": 1e5, "velocity": 1e3}
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)
_COUNTS = {1: "one number", 3: "three numbers"}


class Notes:
    """Errors, which are reported together at the end of reading, and diagnostics of a file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.errors: list[UrdfError] = []
        self.diagnostics: list[Diagnostic] = []

    def error(
        self, line: int | None, element: str, got: str, expected: str | None = None, do: str | None = None
    ) -> None:
        """Add an error."""
        self.errors.append(
            UrdfError(got, file=self.path, line=line, element=element, expected=expected, do=do)
        )

    def warn(self, line: int | None, code: str, where: str, message: str) -> None:
        """Add a warning."""
        self.diagnostics.append(Diagnostic("warning", code, where, line, message))


def first_child(notes: Notes, element: etree._Element, tag: str, where: str) -> etree._Element | None:
    """Return the first child with this tag, or None; repeated ones, which parsers treat differently, are reported."""
    children = element.findall(tag)
    if len(children) > 1:
        message = f"{len(children)} <{tag}> elements: the first is taken, the others are ignored"
        notes.warn(children[1].sourceline, "repeated-element", where, message)
    return children[0] if children else None


def read_triple(
    notes: Notes, element: etree._Element, key: str, where: str, default: Vector = (0.0, 0.0, 0.0)
) -> Vector:
    """Return three numbers; the default if the attribute is absent or, with an error, unusable."""
    text = element.get(key)
    if text is None:
        return default
    values = _parsed(notes, element, text, 3, f"{where} {key}", bounded=True)
    return default if values is None else (values[0], values[1], values[2])


def read_number(
    notes: Notes, element: etree._Element, key: str, where: str, *, bounded: bool = True
) -> float | None:
    """Return a number; None if the attribute is absent or, with an error, unusable."""
    text = element.get(key)
    values = None if text is None else _parsed(notes, element, text, 1, f"{where} {key}", bounded)
    return None if values is None else values[0]


def read_limit(notes: Notes, element: etree._Element, key: str, where: str) -> float | None:
    """Read a limit; None without a limit: absent, inf, nan, or beyond the range of joints."""
    text = (element.get(key) or "").strip().lower()
    if text.lstrip("+-") in ("inf", "infinity", "nan"):
        return None
    value = read_number(notes, element, key, where, bounded=False)
    return None if value is None or abs(value) >= UNLIMITED[key] else value


def read_text_number(notes: Notes, element: etree._Element, tag: str, where: str) -> float | None:
    """Return the number in the text of a child element; None if it is absent or, with an error, unusable."""
    child = element.find(tag)
    if child is None or not (child.text or "").strip():
        return None
    values = _parsed(notes, child, child.text or "", 1, f"{where} {tag}", bounded=True)
    return None if values is None else values[0]


def _parsed(
    notes: Notes, element: etree._Element, text: str, count: int, where: str, bounded: bool
) -> list[float] | None:
    """Return ``count`` finite numbers; None, with an error, for other text.

    bounded: whether magnitudes are at most MAX_MAGNITUDE; not for limits of joints, which may mean "unlimited".
    """
    if "${" in text or "$(" in text:
        note_unexpanded(notes, element, where, text)
        return None
    # float() accepts nan, inf, 1_000 and Arabic digits, which other readers of URDF reject
    words = text.split()
    expected = _COUNTS[count]
    if len(words) != count:
        excerpt = text if len(text) <= MAX_NUMBER_TEXT else f"{text[:MAX_NUMBER_TEXT]}..."
        notes.error(element.sourceline, where, f"{len(words)} numbers ({excerpt!r})", expected)
        return None
    for word in words:
        if len(word) > MAX_NUMBER_TEXT:
            got = f"a number of {len(word)} characters"
            notes.error(element.sourceline, where, got, f"at most {MAX_NUMBER_TEXT}")
            return None
        if not _NUMBER.fullmatch(word):
            hint = "separate numbers by spaces" if "," in word else None
            notes.error(element.sourceline, where, repr(word), f"{expected} in decimal notation", hint)
            return None
    values = list(map(float, words))
    if not all(isfinite(value) and (not bounded or abs(value) <= MAX_MAGNITUDE) for value in values):
        bound = f"within +-{MAX_MAGNITUDE:g}" if bounded else "within the range of a float"
        notes.error(element.sourceline, where, repr(text), f"{expected} {bound}")
        return None
    return values


def note_unexpanded(notes: Notes, element: etree._Element, where: str, text: str) -> None:
    """Add an error for a value that contains a xacro expression."""
    do = "expand the file with the xacro command first"
    notes.error(
        element.sourceline, where, f"the xacro expression {text[:MAX_NUMBER_TEXT]!r}", "a plain value", do
    )
