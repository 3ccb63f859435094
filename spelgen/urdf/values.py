"""Checked reading of the elements of a URDF, and the list of defects of a file.

The package yourdfpy is not used to read the numbers of an arm: it does not report lines, replaces absent inertias by
1.0, converts origins to matrices and drops mechanical reductions. Here each number is checked as text first (count,
length, finiteness). Tests compare with yourdfpy all values that it does not change.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from difflib import SequenceMatcher
from math import isfinite
from pathlib import Path

from lxml import etree

from spelgen.errors import Diagnostic, UrdfError
from spelgen.urdf.robot import Vector

# [m, rad, kg, kg m2] Largest magnitude of a number in a URDF, limits excepted: products of a few such numbers do not
# overflow a float.
MAX_MAGNITUDE = 1e12
MAX_NAME = 256
# [rad, m; Nm, N; rad/s, m/s] A limit of at least this magnitude means that the joint has no limit: exporters write 1e9,
# 1e16 or DBL_MAX in this case.
UNLIMITED = {"lower": 1e3, "upper": 1e3, "effort": 1e5, "velocity": 1e3}
# {element of a joint or inertial: its optional attributes}. An attribute with a name similar to an optional attribute
# is an error, because a misspelt optional attribute would be ignored silently. Text or children in these elements,
# which SDF has, are errors. <origin> has optional attributes, xyz and rpy, but its list is empty, because
# `elements._read_origin` refuses all other attributes.
_LEAVES = {
    "origin": (),
    "axis": (),
    "limit": ("lower", "upper", "effort", "velocity"),
    "dynamics": ("damping", "friction"),
    "mimic": ("multiplier", "offset"),
    "mass": (),
    "inertia": ("ixy", "ixz", "iyz"),
}
# [1] A name with at least this similarity to a name of the URDF format is treated as its misspelling. In the URDFs
# of ../shared (arms and cases), all names that are not part of the format have smaller similarities.
_SIMILARITY = 0.75
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)


@dataclass
class Notes:
    """Errors and diagnostics of one URDF file. `read_urdf` collects them, and raises all errors together at the end."""

    path: Path
    errors: list[UrdfError] = field(default_factory=list)
    diagnostics: list[Diagnostic] = field(default_factory=list)

    def error(
        self, line: int | None, element: str, got: str, expected: str | None = None, do: str | None = None
    ) -> None:
        """Add an error about an element in a line of the file; arguments as for `UrdfError`."""
        error = UrdfError(got, file=self.path, line=line, element=element, expected=expected, do=do)
        self.errors.append(error)

    def warn(self, line: int | None, code: str, where: str, message: str) -> None:
        """Add a warning. code: code of the ``Diagnostic``; where: name of the element."""
        self.diagnostics.append(Diagnostic("warning", code, where, line, message))

    def add_as_warnings(self, optional: Notes) -> None:
        """Add the notes on optional elements, such as limits of fixed joints; their errors are added as warnings.

        The warnings state that the value is treated as absent.
        """
        self.diagnostics += optional.diagnostics
        for error in optional.errors:
            message = f"got {error.got}, expected {error.expected}: taken as absent"
            self.warn(error.line, "unusable-value", str(error.element), message)


@dataclass(frozen=True)
class Element:
    """An element of a URDF with checked access to its attributes.

    Attributes:
        notes: the list to which errors and warnings about the element are added.
        xml: the element of lxml; None if it is absent: all attributes are then absent, too.
        where: name of the element in messages.
    """

    notes: Notes
    xml: etree._Element | None
    where: str

    @property
    def line(self) -> int:
        """Line of the element in the file; 0 if the element is absent."""
        return 0 if self.xml is None else int(self.xml.sourceline)

    def error(self, got: str, expected: str | None = None, do: str | None = None, key: str = "") -> None:
        """Add an error about the element or, if ``key`` is given, its attribute; other arguments as for `UrdfError`."""
        self.notes.error(self.line, f"{self.where} {key}".rstrip(), got, expected, do)

    def child(self, tag: str) -> Element:
        """Return the first child with this tag, which may be absent.

        Several children with the tag cause a warning, because parsers of URDF differ in which of them they use.
        """
        children = [] if self.xml is None else self.xml.findall(tag)
        if len(children) > 1:
            message = f"{len(children)} <{tag}> elements: the first is taken, the others are ignored"
            self.notes.warn(children[1].sourceline, "repeated-element", self.where, message)
        child = Element(self.notes, children[0] if children else None, f"{self.where} {tag}")
        if self.xml is not None:
            # Misspelt limits and friction count as absent, with a warning. Other misspelt content is an error, because
            # defaults in its place, such as a pose of zero, would make the model wrong.
            ignored = Notes(self.notes.path)
            replace(child, notes=ignored)._find_ignored(tag, self.xml)
            if tag in ("limit", "dynamics"):
                self.notes.add_as_warnings(ignored)
            else:
                self.notes.errors += ignored.errors
        return child

    def _find_ignored(self, tag: str, parent: etree._Element) -> None:
        """Add errors for content that would be ignored.

        If the element ``tag`` is absent, this is a misspelt element in ``parent``. If it is present, this is text or
        elements inside it, and its misspelt attributes.
        """
        if self.xml is None:
            for sibling in parent.iterchildren(etree.Element):
                name = etree.QName(sibling).localname
                is_meant = _is_spelling(name, tag) or (name, tag) == ("pose", "origin")
                if is_meant and sibling.tag not in _LEAVES:
                    got = f"the element <{f'{sibling.prefix}:' if sibling.prefix else ''}{name}>"
                    self.notes.error(sibling.sourceline, self.where, got, f"<{tag}>", "correct or remove it")
        elif tag in _LEAVES:
            if (self.xml.text or "").strip() or next(self.xml.iterchildren(etree.Element), None) is not None:
                self.error("text or elements inside it", "only attributes", "write its values as attributes")
            absent = [name for name in _LEAVES[tag] if name not in self.xml.attrib]
            for key in self.xml.attrib:
                name = next((name for name in absent if _is_spelling(key, name)), None)
                if key not in _LEAVES[tag] and name is not None:
                    self.error(f"the attribute {key!r}", repr(name), "correct or remove it")

    def text(self, key: str) -> str | None:
        """Return the text of the attribute ``key``; None if the attribute or the element is absent."""
        # An absent element counts as an element without attributes, so that callers need no branch for it.
        return None if self.xml is None else self.xml.get(key)

    def name(self) -> str | None:
        """Return the name of the element; add an error and return None if it has no usable name."""
        name = self.text("name")
        if not name or not name.strip():
            self.error("no name" if name is None else "an empty name", "a name", 'add name="..."')
        # The length of a name is bounded, because names occur in error messages, file names and the emitted module.
        elif len(name) > MAX_NAME:
            self.error(f"a name of {len(name)} characters", f"at most {MAX_NAME}")
        elif not self._is_unexpanded(name, "name"):
            return name
        return None

    def triple(self, key: str, default: Vector = (0.0, 0.0, 0.0)) -> Vector:
        """Return the three numbers in the attribute ``key``, or ``default`` if the attribute is absent.

        For an unusable text, add an error and return the default.
        """
        values = self._numbers(self.text(key), key, 3)
        return (values[0], values[1], values[2]) if values else default

    def number(self, key: str) -> float | None:
        """Return the number in the attribute ``key``; None if the attribute is absent.

        For an unusable text, add an error and return None.
        """
        values = self._numbers(self.text(key), key)
        return values[0] if values else None

    def limit(self, key: str) -> float | None:
        """Return the limit in the attribute ``key``; None if it is absent, inf, nan, or at least ``UNLIMITED[key]``.

        For an unusable text, add an error and return None.
        """
        text = self.text(key)
        if text and text.strip().lower().lstrip("+-") in ("inf", "infinity", "nan"):
            return None
        values = self._numbers(text, key, bounded=False)
        return values[0] if values and abs(values[0]) < UNLIMITED[key] else None

    def number_in_text(self, tag: str) -> float | None:
        """Return the number in the text of the child element ``tag``; None if the child or its text is absent.

        For an unusable text, add an error and return None.
        """
        child = None if self.xml is None else self.xml.find(tag)
        text = "" if child is None else child.text or ""
        values = Element(self.notes, child, self.where)._numbers(text if text.strip() else None, tag)
        return values[0] if values else None

    def _numbers(self, text: str | None, key: str, count: int = 1, bounded: bool = True) -> list[float]:
        """Return the ``count`` finite numbers in a text, the value of the attribute or child element ``key``.

        The list is empty if the text is None. It is also empty, and an error is added, if the text does not consist of
        ``count`` finite numbers. bounded: if True, magnitudes above MAX_MAGNITUDE are errors; False for limits of
        joints, because a huge limit means "unlimited".
        """
        if text is None or self._is_unexpanded(text, key):
            return []
        # The text of a number is checked before `float`, which accepts nan, inf, 1_000 and Arabic digits: other readers
        # of URDF reject these.
        words, longest = text.split(), 64
        expected = "one number" if count == 1 else "three numbers"
        if len(words) != count:
            excerpt = text if len(text) <= longest else f"{text[:longest]}..."
            self.error(f"{len(words)} numbers ({excerpt!r})", expected, key=key)
            return []
        for word in words:
            # A number with too many characters is a sign of a damaged file: no exporter writes such numbers.
            if len(word) > longest:
                self.error(f"a number of {len(word)} characters", f"at most {longest}", key=key)
                return []
            if not _NUMBER.fullmatch(word):
                hint = "write decimal points, and spaces between numbers" if "," in word else None
                self.error(repr(word), f"{expected} in decimal notation", hint, key)
                return []
        values = list(map(float, words))
        if not all(isfinite(value) and (not bounded or abs(value) <= MAX_MAGNITUDE) for value in values):
            bound = f"within +-{MAX_MAGNITUDE:g}" if bounded else "within the range of a float"
            self.error(repr(text), f"{expected} {bound}", key=key)
            return []
        return values

    def _is_unexpanded(self, text: str, key: str) -> bool:
        """Whether a text contains a xacro expression; if it does, an error about the attribute ``key`` is added."""
        is_unexpanded = "${" in text or "$(" in text
        if is_unexpanded:
            do = "expand the file with the xacro command first"
            self.error(f"the xacro expression {text[:64]!r}", "a plain value", do, key)
        return is_unexpanded


def _is_spelling(text: str, name: str) -> bool:
    """Return True if ``text`` is probably a misspelling of ``name``; upper and lower case count as equal."""
    return SequenceMatcher(None, text.lower(), name).ratio() >= _SIMILARITY
