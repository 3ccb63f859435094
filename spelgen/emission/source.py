"""Values -> source text: calls, tuples and assignments laid out as a formatter would."""

from __future__ import annotations

import json
from dataclasses import dataclass

WIDTH = 110
_FEW = 3  # equal items that are written out


@dataclass(frozen=True)
class Code:
    """An expression that stands as it is: a name, or an expression of names."""

    text: str


@dataclass(frozen=True)
class Call:
    """A call; an argument without a name stands under None."""

    callee: str
    arguments: tuple[tuple[str | None, object], ...]


def call(callee: str, *positional: object, **named: object) -> Call:
    """The call of ``callee`` with these arguments."""
    arguments: list[tuple[str | None, object]] = [(None, value) for value in positional]
    return Call(callee, (*arguments, *named.items()))


def assignment(target: str, value: object, indent: int = 0) -> str:
    """``target = value``, over as many lines as it takes."""
    return " " * indent + laid_out(f"{target} = ", value, indent)


def laid_out(start: str, value: object, indent: int = 0) -> str:
    """Return ``start`` and ``value`` as a formatter lays them out, where that takes three lines at most.

    Else they are dense, for numbers are read by the row, and marked for the formatter to leave alone.
    """
    flat = start + _flat(value)
    if indent + len(flat) <= WIDTH or not _items(value) or _alike(value):
        return flat
    if isinstance(value, Call):
        body = " " * (indent + 4) + _joined(value)
        if len(body) <= WIDTH:
            return f"{start}{value.callee}(\n{body}\n{' ' * indent})"
    return f"{_dense(start, value, indent)}  # fmt: skip"


def _dense(start: str, value: object, indent: int) -> str:
    """``start`` and ``value``, whose items share lines where they fit."""
    inner = " " * (indent + 4)
    lines = [f"{start}{_callee(value)}(", inner]
    for key, item in _items(value):
        text = f"{key}{_flat(item)},"
        if len(inner + text) > WIDTH and _items(item) and not _alike(item):
            text = f"{_dense(key, item, indent + 4)},"
        line = lines[-1]
        if line == inner:
            lines[-1] += text
        elif "\n" in text or "\n" in line or len(line) + len(text) >= WIDTH:
            lines.append(inner + text)
        else:
            lines[-1] += f" {text}"
    return "\n".join([*lines, " " * indent + ")"])


def _callee(value: object) -> str:
    """What stands before the parentheses."""
    return value.callee if isinstance(value, Call) else ""


def _items(value: object) -> list[tuple[str, object]]:
    """What stands between the parentheses: what precedes each item, and the item."""
    items: list[tuple[str, object]] = []
    if isinstance(value, Call):
        for key, item in value.arguments:
            items.append((f"{key}=" if key else "", item))
    elif isinstance(value, tuple):
        for item in value:
            items.append(("", item))
    return items


def _alike(value: object) -> bool:
    """Whether it is a tuple of one thing again and again."""
    return isinstance(value, tuple) and len(value) > _FEW and value.count(value[0]) == len(value)


def _joined(value: object) -> str:
    return ", ".join(key + _flat(item) for key, item in _items(value))


def _flat(value: object) -> str:
    if isinstance(value, Code):
        return value.text
    if isinstance(value, str):
        return json.dumps(value)
    if isinstance(value, tuple):
        if _alike(value):
            return f"({_flat(value[0])},) * {len(value)}"
        if len(value) == 1:
            return f"({_flat(value[0])},)"
        return f"({_joined(value)})"
    if isinstance(value, Call):
        return f"{value.callee}({_joined(value)})"
    return repr(value)
