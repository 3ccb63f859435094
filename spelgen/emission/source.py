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


def laid_out(start: str, value: object, indent: int = 0, end: str = "") -> str:
    """``start``, ``value`` and ``end`` on one line, or with an item of the value a line."""
    flat = start + _flat(value) + end
    if indent + len(flat) <= WIDTH or not _items(value) or _alike(value):
        return flat
    inner = " " * (indent + 4)
    opening, closing = (f"{value.callee}(", ")") if isinstance(value, Call) else ("(", ")")
    body = inner + ", ".join(key + _flat(item) for key, item in _items(value))
    if isinstance(value, Call) and len(body) <= WIDTH:
        return "\n".join([start + opening, body, " " * indent + closing + end])
    lines = [inner + laid_out(key, item, indent + 4, ",") for key, item in _items(value)]
    return "\n".join([start + opening, *lines, " " * indent + closing + end])


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
