"""Errors as a user reads them: one exception per subject; diagnostics stop nothing."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Literal

Severity = Literal["info", "warning"]
LONGEST_LIST = 50  # errors of one pass that are printed
LONGEST_TEXT = 2000  # characters of a part of a message that are printed


class SpelgenError(Exception):
    """An error printed as ``FILE:LINE: element: got X, expected Y; do Z``, without the absent parts.

    ``got`` alone may be a full statement; it is then printed as it is, without the word "got".
    """

    def __init__(
        self,
        got: str,
        *,
        file: Path | str | None = None,
        line: int | None = None,
        element: str | None = None,
        expected: str | None = None,
        do: str | None = None,
    ) -> None:
        super().__init__(got)
        self.got = got
        self.file = None if file is None else str(file)
        self.line = line
        self.element = element
        self.expected = expected
        self.do = do

    def __str__(self) -> str:
        statement = _in_short(self.got)
        if self.expected is not None:
            statement = f"got {statement}, expected {_in_short(self.expected)}"
        place = ":".join(str(x) for x in (self.file, self.line) if x is not None)
        message = ": ".join(x for x in (_in_short(place), _in_short(self.element or ""), statement) if x)
        if self.do is not None:
            message += f"; {_in_short(self.do)}"
        return message


class UrdfError(SpelgenError):
    """The robot description is malformed or says something impossible."""


class ArmError(SpelgenError):
    """The robot description is sound, but the arm asked for cannot be taken from it."""


class SettingsError(SpelgenError):
    """A sidecar file or an option holds something unknown or impossible."""


class OptionError(SettingsError):
    """An option that does not apply to what is asked for; the text names what it belongs to."""

    def __init__(self, option: str, belongs: str) -> None:
        super().__init__(belongs, element=option)
        self.option = option


class LogError(SpelgenError):
    """Measured data is missing, malformed or not what it claims to be."""


class ModuleError(SpelgenError):
    """An emitted module is missing, foreign or stale."""


class RunError(SpelgenError):
    """A training run cannot be started, resumed or read."""


class SpelgenErrors(SpelgenError):
    """Several errors found in one pass, told one per line; what is the same in several files is told once."""

    def __init__(self, errors: Sequence[SpelgenError]) -> None:
        super().__init__(f"{len(errors)} errors")
        self.errors = tuple(errors)

    def __str__(self) -> str:
        groups: dict[tuple[object, ...], list[SpelgenError]] = {}
        for error in self.errors:
            key = (error.line, error.element, error.got, error.expected, error.do)
            groups.setdefault(key, []).append(error)
        lines = [_once(group) for group in list(groups.values())[:LONGEST_LIST]]
        if len(groups) > LONGEST_LIST:
            lines.append(f"and {len(groups) - LONGEST_LIST} more like these")
        return "\n".join(lines)


def _once(alike: Sequence[SpelgenError]) -> str:
    """Return the first of errors that differ in their files alone, and the files of the others."""
    first = alike[0]
    files = dict.fromkeys(error.file for error in alike if error.file and error.file != first.file)
    if not files:
        return str(first)
    return f"{first}\n  the same: {shortened(list(files), 5)}"


def _in_short(text: str) -> str:
    """Return a text, or the ends of one that no one reads: a file may hold a name of a million characters."""
    if len(text) <= LONGEST_TEXT:
        return text
    half = LONGEST_TEXT // 3
    return f"{text[:half]}... ({len(text)} characters) ...{text[-half:]}"


def in_one_line(error: BaseException) -> str:
    """Return the kind of an exception and what it says."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def collect(errors: Sequence[SpelgenError]) -> None:
    """Raise what was gathered: nothing, the one error, or a ``SpelgenErrors`` of several."""
    if len(errors) == 1:
        raise errors[0]
    if errors:
        raise SpelgenErrors(errors)


def suggestion(name: str, names: Iterable[str]) -> str:
    """Return a hint for someone who wrote ``name``: the nearest of the known ``names``, or the first ten."""
    names = list(names)
    nearest = get_close_matches(name, names, n=1)
    if nearest:
        return f"did you mean {nearest[0]!r}?"
    hint = f"known are {', '.join(map(repr, names[:10]))}"
    if len(names) > 10:
        hint += f" and {len(names) - 10} more"
    return hint


def shortened(names: Sequence[str], limit: int) -> str:
    """Return the names, or the first ``limit`` of them and how many more there are."""
    rest = len(names) - limit
    if rest <= 1:
        return ", ".join(names)
    return ", ".join([*names[:limit], f"and {rest} more"])


@dataclass(frozen=True)
class Diagnostic:
    """Something a user should know that stops nothing; ``code`` is kebab-case and stable."""

    severity: Severity
    code: str
    where: str
    line: int | None
    message: str

    def __str__(self) -> str:
        return f"{self.severity}: {self.where}: {self.message}"

    def to_dict(self) -> dict[str, object]:
        """Return the five fields as a JSON object, in the order of the public contract."""
        return asdict(self)
