"""The checked values of URDF attributes, and where defects are noted while a file is read.

The numbers are read here and not through yourdfpy: each must be checked as text first (count, length,
finiteness, line), and what yourdfpy adds after that is to fill in absent inertia with 1.0, turn origins into
matrices and lose mechanical reductions. The tests hold the two readings against each other where yourdfpy is
faithful.
"""

from __future__ import annotations

import re
from math import isfinite
from pathlib import Path

from lxml import etree

from spelgen.errors import Diagnostic, UrdfError
from spelgen.urdf.robot import Vector

MAX_MAGNITUDE = 1e12  # of a number that becomes exact geometry: products of a few are still floats
MAX_NUMBER_TEXT = 64
# [rad, m; Nm, N; per second] From these on a limit states that there is none: exporters write 1e9, 1e16 or DBL_MAX.
UNLIMITED = {"lower": 1e3, "upper": 1e3, "effort": 1e5, "velocity": 1e3}
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)
_COUNTS = {1: "one number", 3: "three numbers"}


class Notes:
    """What is gathered while a file is read: errors, told together at the end, and diagnostics."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.errors: list[UrdfError] = []
        self.diagnostics: list[Diagnostic] = []

    def error(
        self, line: int | None, element: str, got: str, expected: str | None = None, do: str | None = None
    ) -> None:
        """Note an error."""
        self.errors.append(
            UrdfError(got, file=self.path, line=line, element=element, expected=expected, do=do)
        )

    def warn(self, line: int | None, code: str, where: str, message: str) -> None:
        """Note a warning."""
        self.diagnostics.append(Diagnostic("warning", code, where, line, message))


def first_child(notes: Notes, element: etree._Element, tag: str, where: str) -> etree._Element | None:
    """The first child of that tag; repeated ones are said."""
    children = element.findall(tag)
    # parsers differ in which of them they take: the user must know
    if len(children) > 1:
        message = f"{len(children)} <{tag}> elements: the first is taken, the others are ignored"
        notes.warn(children[1].sourceline, "repeated-element", where, message)
    return children[0] if children else None


def read_triple(
    notes: Notes, element: etree._Element, key: str, where: str, default: Vector = (0.0, 0.0, 0.0)
) -> Vector:
    """Three numbers; the default where the attribute is absent or, with an error noted, unusable."""
    # URDF gives a default to every absent triple: no origin is the identity
    text = element.get(key)
    if text is None:
        return default
    values = _parsed(notes, element, text, 3, f"{where} {key}", bounded=True)
    return default if values is None else (values[0], values[1], values[2])


def read_number(
    notes: Notes, element: etree._Element, key: str, where: str, *, bounded: bool = True
) -> float | None:
    """One number; None where the attribute is absent or, with an error noted, unusable."""
    text = element.get(key)
    values = None if text is None else _parsed(notes, element, text, 1, f"{where} {key}", bounded)
    return None if values is None else values[0]


def read_limit(notes: Notes, element: etree._Element, key: str, where: str) -> float | None:
    """Read a limit; None if it states none: absent, inf, nan, or beyond what joints have."""
    text = (element.get(key) or "").strip().lower()
    if text.lstrip("+-") in ("inf", "infinity", "nan"):
        return None
    value = read_number(notes, element, key, where, bounded=False)
    return None if value is None or abs(value) >= UNLIMITED[key] else value


def read_text_number(notes: Notes, element: etree._Element, tag: str, where: str) -> float | None:
    """The number that a child element holds as text; None as for an attribute."""
    child = element.find(tag)
    if child is None or not (child.text or "").strip():
        return None
    values = _parsed(notes, child, child.text or "", 1, f"{where} {tag}", bounded=True)
    return None if values is None else values[0]


def _parsed(
    notes: Notes, element: etree._Element, text: str, count: int, where: str, bounded: bool
) -> list[float] | None:
    """``count`` finite numbers; None, with an error noted, for anything else.

    Only what becomes exact geometry is bounded in size: limits may be as large as a float to say "none".
    """
    if "${" in text or "$(" in text:
        note_unexpanded(notes, element, where, text)
        return None
    # float() takes nan, inf, 1_000 and Arabic digits, which no other reader of URDF does
    words = text.split()
    expected = _COUNTS[count]
    if len(words) != count:
        shown = text if len(text) <= MAX_NUMBER_TEXT else f"{text[:MAX_NUMBER_TEXT]}..."
        notes.error(element.sourceline, where, f"{len(words)} numbers ({shown!r})", expected)
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
    # a size beyond MAX_MAGNITUDE would overflow as soon as two of them are multiplied
    values = list(map(float, words))
    if not all(isfinite(value) and (not bounded or abs(value) <= MAX_MAGNITUDE) for value in values):
        bound = f"within +-{MAX_MAGNITUDE:g}" if bounded else "within the range of a float"
        notes.error(element.sourceline, where, repr(text), f"{expected} {bound}")
        return None
    return values


def note_unexpanded(notes: Notes, element: etree._Element, where: str, text: str) -> None:
    """Note that a value still holds a xacro expression."""
    do = "expand the file with the xacro command first"
    notes.error(
        element.sourceline, where, f"the xacro expression {text[:MAX_NUMBER_TEXT]!r}", "a plain value", do
    )
