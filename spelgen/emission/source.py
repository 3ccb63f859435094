"""Values -> source text: calls, tuples and assignments, laid out to be read."""

import json
from dataclasses import dataclass

WIDTH = 110
_STEP = 4  # blanks per level of indentation
SKIP = "  # fmt: skip"  # for ruff: numbers are read row by row


@dataclass(frozen=True)
class Code:
    """A name in source code."""

    text: str


@dataclass(frozen=True)
class Call:
    """A call; positional arguments have the name None."""

    callee: str
    arguments: tuple[tuple[str | None, object], ...]


def call(callee: str, *positional: object, **named: object) -> Call:
    """Return the call of ``callee`` with these arguments."""
    arguments: list[tuple[str | None, object]] = [(None, value) for value in positional]
    return Call(callee, (*arguments, *named.items()))


def filled(start: str, value: object, indent: int, reserved: int = 0) -> str:
    """Return ``start`` and ``value``, in one line if it and ``reserved`` characters fit, else in several."""
    text = start + flat(value)
    if indent + len(text) + reserved < WIDTH or not _items(value) or _alike(value):
        return text
    inner = " " * (indent + _STEP)
    opening, closing = "{}" if isinstance(value, dict) else "()"
    callee = value.callee if isinstance(value, Call) else ""
    # as many items per line as fit: matrices stay readable as rows
    lines = [f"{start}{callee}{opening}", inner]
    for key, item in _items(value):
        text = f"{filled(key, item, indent + _STEP)},"
        line = lines[-1]
        if line == inner:
            lines[-1] += text
        elif "\n" in text or "\n" in line or len(line) + len(text) >= WIDTH:
            lines.append(inner + text)
        else:
            lines[-1] += f" {text}"
    return "\n".join([*lines, " " * indent + closing])


def listed_call(start: str, value: Call, indent: int) -> str:
    """Return ``start`` and a call with an argument per line."""
    inner = " " * (indent + _STEP)
    lines = [f"{inner}{filled(key, item, indent + _STEP)}," for key, item in _items(value)]
    return "\n".join([f"{start}{value.callee}(", *lines, " " * indent + ")"])


def flat(value: object) -> str:
    """Return a value in one line. Any text from a file becomes a string literal of ASCII."""
    if isinstance(value, Code):
        return value.text
    if isinstance(value, str):
        return json.dumps(value) if value.isascii() and value.isprintable() else _escaped(value)
    if isinstance(value, tuple):
        if _alike(value):
            return f"({flat(value[0])},) * {len(value)}"
        return f"({flat(value[0])},)" if len(value) == 1 else f"({_joined(value)})"
    if isinstance(value, dict):
        return "{" + _joined(value) + "}"
    return f"{value.callee}({_joined(value)})" if isinstance(value, Call) else repr(value)


def _escaped(text: str) -> str:
    """Return a string literal in double quotes; JSON has no escape for characters beyond 16 bits."""
    return '"' + "".join(rf"\U{ord(x):08x}" if not x.isascii() else json.dumps(x)[1:-1] for x in text) + '"'


def _items(value: object) -> list[tuple[str, object]]:
    """Return (prefix, item) for the items of a call ("key="), a dictionary ("key: ") or a tuple (""); else []."""
    if isinstance(value, Call):
        return [(f"{key}=" if key else "", item) for key, item in value.arguments]
    if isinstance(value, dict):
        return [(f"{flat(key)}: ", item) for key, item in value.items()]
    return [("", item) for item in value] if isinstance(value, tuple) else []


def _alike(value: object) -> bool:
    """Test whether a value is a tuple of equal items, of which more than three are written as a product."""
    return isinstance(value, tuple) and len(value) > 3 and value.count(value[0]) == len(value)


def _joined(value: object) -> str:
    return ", ".join(key + flat(item) for key, item in _items(value))
