"""What a user reads when something is wrong: one exception per subject; diagnostics stop nothing."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Literal

Severity = Literal["info", "warning"]
_TOLD_AT_MOST = 50


class SpelgenError(Exception):
    """An error told as ``FILE:LINE: element: got X, expected Y; do Z``, with the absent parts left out.

    ``got`` alone may be a full statement; it is then told as it is, without the word "got".
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
        statement = self.got if self.expected is None else f"got {self.got}, expected {self.expected}"
        place = ":".join(str(part) for part in (self.file, self.line) if part is not None)
        told = ": ".join(part for part in (place, self.element, statement) if part)
        return told if self.do is None else f"{told}; {self.do}"


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
        alike: dict[tuple[object, ...], list[SpelgenError]] = {}
        for error in self.errors:
            alike.setdefault((error.line, error.element, error.got, error.expected, error.do), []).append(
                error
            )
        told = [_told_once(group) for group in list(alike.values())[:_TOLD_AT_MOST]]
        left = len(alike) - len(told)
        return "\n".join(told + ([f"and {left} more like these"] if left else []))


def _told_once(alike: Sequence[SpelgenError]) -> str:
    """The first of errors that differ in their files alone, and the files of the others."""
    others = dict.fromkeys(error.file for error in alike[1:] if error.file and error.file != alike[0].file)
    if not others:
        return str(alike[0])
    return f"{alike[0]}\n  the same: {shortened(list(others), 5)}"


def collect(errors: Sequence[SpelgenError]) -> None:
    """Raise what was gathered: nothing, the one error, or a ``SpelgenErrors`` of several."""
    if len(errors) == 1:
        raise errors[0]
    if errors:
        raise SpelgenErrors(errors)


def suggestion(name: str, known: Iterable[str]) -> str:
    """Return what to tell someone who wrote ``name``: the nearest ``known`` name, or the first ten."""
    names = list(known)
    nearest = get_close_matches(name, names, n=1)
    if nearest:
        return f"did you mean {nearest[0]!r}?"
    listed = ", ".join(repr(each) for each in names[:10])
    return f"known are {listed}" + (f" and {len(names) - 10} more" if len(names) > 10 else "")


def shortened(names: Sequence[str], most: int) -> str:
    """The names, or the first ``most`` of them and how many more there are."""
    left = len(names) - most
    return ", ".join(names if left <= 1 else [*names[:most], f"and {left} more"])


@dataclass(frozen=True)
class Diagnostic:
    """Something a user should know that stops nothing; ``code`` is kebab-case and stable."""

    severity: Severity
    code: str
    where: str
    line: int | None
    message: str

    def to_dict(self) -> dict[str, Any]:
        """Return the five fields as a JSON object, in the order of the public contract."""
        return asdict(self)
