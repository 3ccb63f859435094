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
    return Call(callee, (*((None, value) for value in positional), *named.items()))


def assignment(target: str, value: object, indent: int = 0) -> str:
    """``target = value``, over as many lines as it takes."""
    return " " * indent + laid_out(f"{target} = ", value, indent)


def laid_out(start: str, value: object, indent: int = 0) -> str:
    """``start`` and ``value`` as a formatter lays them out, where that takes three lines at most; else densely, for
    numbers are read by the row, and marked for the formatter to leave alone.
    """
    inner = " " * (indent + 4)
    flat = start + _flat(value)
    if indent + len(flat) <= WIDTH or not _items(value) or _alike(value):
        return flat
    if isinstance(value, Call):
        body = inner + ", ".join(key + _flat(item) for key, item in _items(value))
        if len(body) <= WIDTH:
            return "\n".join([f"{start}{value.callee}(", body, " " * indent + ")"])
    return f"{_dense(start, value, indent)}  # fmt: skip"


def _dense(start: str, value: object, indent: int) -> str:
    """``start`` and ``value``, whose items share lines where they fit."""
    opening, closing = (f"{value.callee}(", ")") if isinstance(value, Call) else ("(", ")")
    inner = " " * (indent + 4)
    lines = [start + opening, inner]
    for key, item in _items(value):
        text = f"{key}{_flat(item)},"
        if len(inner + text) > WIDTH and _items(item) and not _alike(item):
            text = f"{_dense(key, item, indent + 4)},"
        if lines[-1] != inner and ("\n" in text or "\n" in lines[-1] or len(lines[-1]) + len(text) >= WIDTH):
            lines.append(inner)
        lines[-1] += text if lines[-1] == inner else f" {text}"
    return "\n".join([*lines, " " * indent + closing])


def _items(value: object) -> list[tuple[str, object]]:
    """What stands between the parentheses: what precedes each item, and the item."""
    if isinstance(value, Call):
        return [(f"{key}=" if key else "", item) for key, item in value.arguments]
    return [("", item) for item in value] if isinstance(value, tuple) else []


def _alike(value: object) -> bool:
    """Whether it is a tuple of one thing again and again."""
    return isinstance(value, tuple) and len(value) > _FEW and all(item == value[0] for item in value)


def _flat(value: object) -> str:
    if isinstance(value, Code):
        return value.text
    if isinstance(value, str):
        return json.dumps(value)
    if not isinstance(value, tuple | Call):
        return repr(value)
    if isinstance(value, tuple) and _alike(value):
        return f"({_flat(value[0])},) * {len(value)}"
    inside = ", ".join(key + _flat(item) for key, item in _items(value))
    if isinstance(value, Call):
        return f"{value.callee}({inside})"
    return f"({inside},)" if len(value) == 1 else f"({inside})"
