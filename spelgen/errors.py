"""Errors for users, with one exception per subject, and diagnostics, which do not stop a command."""

from collections.abc import Iterable, Sequence
from dataclasses import KW_ONLY, asdict, dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Literal

Severity = Literal["info", "warning"]
MAX_ERRORS = 50  # largest number of printed errors
MAX_TEXT = 2000  # largest printed length of each field of an error, in characters


@dataclass(eq=False, repr=False)
class SpelgenError(Exception):
    """An error printed as ``FILE:LINE: element: got X, expected Y; do Z``; parts that are None are not printed.

    If ``expected`` is None, ``got`` is a full statement, printed without the word "got".
    """

    got: str
    _: KW_ONLY
    file: Path | str | None = None
    line: int | None = None
    element: str | None = None
    expected: str | None = None
    do: str | None = None

    def __post_init__(self) -> None:
        # `args` must be the positional arguments of this class: copying an exception, as Ray does, calls
        # `class(*args)`.
        super().__init__(self.got)
        # Callers give the file as text or as a path. `SpelgenErrors` compares the files of errors, so both become text.
        if self.file is not None:
            self.file = str(self.file)

    def __str__(self) -> str:
        statement = _truncated(self.got)
        if self.expected is not None:
            statement = f"got {statement}, expected {_truncated(self.expected)}"
        # Compilers print FILE:LINE in this form, and editors open the file at that line.
        location = ":".join(str(x) for x in (self.file, self.line) if x is not None)
        message = ": ".join(x for x in (_truncated(location), _truncated(self.element or ""), statement) if x)
        if self.do is not None:
            message += f"; {_truncated(self.do)}"
        return message


class UrdfError(SpelgenError):
    """The robot description is malformed or inconsistent."""


class ArmError(SpelgenError):
    """The robot description is valid, but does not contain the requested arm."""


class SettingsError(SpelgenError):
    """A settings file or an option has an unknown or invalid value."""


class OptionError(SettingsError):
    """An option that the chosen command, objective or model does not have; ``belongs`` states where it applies."""

    def __init__(self, option: str, belongs: str) -> None:
        super().__init__(belongs, element=option)
        self.args = (option, belongs)


@dataclass(eq=False, repr=False)
class LogError(SpelgenError):
    """Measured data is missing, malformed or inconsistent with its description.

    ``codes`` are the codes of the checks that found the fault; the option ``--accept CODE`` omits a check.
    """

    _: KW_ONLY
    codes: tuple[str, ...] = ()

    def __str__(self) -> str:
        options = " ".join(f"--accept {code}" for code in self.codes)
        return super().__str__() + (f"; {options} if it is right" if options else "")


class ModuleError(SpelgenError):
    """An emitted module is missing, stale or no module of spelgen."""


class RunError(SpelgenError):
    """A training run cannot be started, resumed or read."""


class SpelgenErrors(SpelgenError):
    """Several errors in one exception, printed one per line; equal errors in several files are printed once."""

    def __init__(self, errors: Sequence[SpelgenError]) -> None:
        super().__init__(f"{len(errors)} errors")
        self.args = (errors,)
        self.errors = tuple(errors)

    def __str__(self) -> str:
        # All logs of one logger often have the same error, which is printed once for all files.
        groups: dict[tuple[object, ...], list[SpelgenError]] = {}
        for error in self.errors:
            key = (error.line, error.element, error.got, error.expected, error.do)
            groups.setdefault(key, []).append(error)
        lines = [_joined(group) for group in list(groups.values())[:MAX_ERRORS]]
        if len(groups) > MAX_ERRORS:
            lines.append(f"and {len(groups) - MAX_ERRORS} more like these")
        return "\n".join(lines)


def _joined(errors: Sequence[SpelgenError]) -> str:
    """Return one text for equal errors in several files: the first error, followed by the names of the other files."""
    first = errors[0]
    files = dict.fromkeys(error.file for error in errors if error.file and error.file != first.file)
    return f"{first}\n  the same: {shortened(list(map(str, files)), 5)}" if files else str(first)


def _truncated(text: str) -> str:
    """Return a text, shortened to its start and end if it is long: a name in a file may have a million characters."""
    if len(text) <= MAX_TEXT:
        return text
    third = MAX_TEXT // 3
    return f"{text[:third]}... ({len(text)} characters) ...{text[-third:]}"


def in_one_line(error: BaseException) -> str:
    """Return the type and message of an exception as one line, for an error message."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def collect(errors: Sequence[SpelgenError]) -> None:
    """Raise the errors, if any: a single error, or ``SpelgenErrors``."""
    if len(errors) == 1:
        raise errors[0]
    if errors:
        raise SpelgenErrors(errors)


def suggestion(name: str, names: Iterable[str]) -> str:
    """Return a hint for an unknown ``name``: the closest of the known ``names``, or the first ten."""
    names = list(names)
    # Only the closest name is suggested: it is most often the intended one, and a list takes time to read.
    nearest = get_close_matches(name, names, n=1)
    if nearest:
        return f"did you mean {nearest[0]!r}?"
    remainder = f" and {len(names) - 10} more" if len(names) > 10 else ""
    return f"known are {', '.join(map(repr, names[:10]))}{remainder}"


def shortened(names: Sequence[str], limit: int) -> str:
    """Return names as text for a message: all of them, or the first ``limit`` of them and the number of the others."""
    omitted = len(names) - limit
    # If only one name would be omitted, it is printed: most names are shorter than `and 1 more`.
    if omitted <= 1:
        return ", ".join(names)
    return ", ".join([*names[:limit], f"and {omitted} more"])


@dataclass(frozen=True)
class Diagnostic:
    """A remark or warning for users about a file, a robot or a log; ``code``, such as ``gap``, names its kind."""

    severity: Severity
    code: str
    where: str
    line: int | None
    message: str

    def __str__(self) -> str:
        return f"{self.severity}: {self.where}: {self.message}"

    def to_dict(self) -> dict[str, object]:
        """Return severity, code, where, line, message as a JSON object; this order is part of the public interface."""
        return asdict(self)
