"""Source text of values: calls, tuples and dictionaries, broken into readable lines."""

import ast
import json
from dataclasses import dataclass

WIDTH = 110
_STEP = 4  # blanks per level of indentation
SKIP = "  # fmt: skip"  # With this comment, ruff does not reformat rows of numbers.


@dataclass(frozen=True)
class Code:
    """A name in source code."""

    text: str


@dataclass(frozen=True)
class Call:
    """A call in source code. arguments: name and value; a positional argument has the name None."""

    callee: str
    arguments: tuple[tuple[str | None, object], ...]


def call(callee: str, *positional: object, **named: object) -> Call:
    """Return a ``Call`` of ``callee`` with these positional and keyword arguments."""
    arguments = [(None, value) for value in positional]
    return Call(callee, (*arguments, *named.items()))


def filled(start: str, value: object, indent: int, reserved: int = 0) -> str:
    """Return the text ``start`` followed by the source text of ``value``.

    The result is one line if this text and ``reserved`` further characters fit into a line, otherwise several lines.
    """
    text = start + flat(value)
    if indent + len(text) + reserved < WIDTH or not _items(value) or _alike(value):
        return text
    inner = " " * (indent + _STEP)
    opening, closing = "{}" if isinstance(value, dict) else "()"
    callee = value.callee if isinstance(value, Call) else ""
    # Lines are filled with items. An item that has several lines starts on its own line.
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
    """Return ``start`` and the text of a call with one line per argument."""
    inner = " " * (indent + _STEP)
    lines = [f"{inner}{filled(key, item, indent + _STEP)}," for key, item in _items(value)]
    return "\n".join([f"{start}{value.callee}(", *lines, " " * indent + ")"])


def flat(value: object) -> str:
    """Return the source text of a value in one line; texts become string literals of ASCII characters."""
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
    """Return a string literal of ASCII characters, with Python's 32-bit escapes for all others.

    JSON has only 16-bit escapes, and needs two of them for a larger code point.
    """
    return '"' + "".join(rf"\U{ord(x):08x}" if not x.isascii() else json.dumps(x)[1:-1] for x in text) + '"'


def _items(value: object) -> list[tuple[str, object]]:
    """Return (prefix, item) for each item of a call, a dictionary or a tuple; [] for other values.

    The prefix is "key=" for a keyword argument of a call, "key: " for a dictionary, otherwise "".
    """
    if isinstance(value, Call):
        return [(f"{key}=" if key else "", item) for key, item in value.arguments]
    if isinstance(value, dict):
        return [(f"{flat(key)}: ", item) for key, item in value.items()]
    return [("", item) for item in value] if isinstance(value, tuple) else []


def _alike(value: object) -> bool:
    """Return True for a tuple of more than three equal items, which is written as a product: ``(0.0,) * 6``."""
    return isinstance(value, tuple) and len(value) > 3 and value.count(value[0]) == len(value)


def _joined(value: object) -> str:
    return ", ".join(key + flat(item) for key, item in _items(value))


def names_in(tree: ast.AST) -> set[str]:
    """Return all names that occur in a syntax tree, including names in annotations."""
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
