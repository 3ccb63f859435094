"""Values -> source text: tables, calls and literals as a formatter would lay them out."""

from __future__ import annotations

import json

WIDTH = 100


def table(start: str, rows: list[str]) -> str:
    """A tuple with a row a line, or on the line that begins with ``start`` where it fits."""
    flat = f"({', '.join(rows)}{',' * (len(rows) == 1)})"
    if len(start) + len(flat) <= WIDTH and "\n" not in flat:
        return flat
    return "(\n" + "".join(f"    {row},\n" for row in rows) + ")"


def call(callee: str, **arguments: object) -> str:
    """A call with its keywords, as a row of a table: on one line, or on one line an argument."""
    parts = [f"{key}={literal(value, indent=8)}" for key, value in arguments.items()]
    flat = f"{callee}({', '.join(parts)})"
    if len(flat) < WIDTH - 4 and "\n" not in flat:
        return flat
    return f"{callee}(\n" + "".join(f"        {part},\n" for part in parts) + "    )"


def literal(value: object, indent: int = 0) -> str:
    """``value`` as source text; a tuple too long for a line has an item a line."""
    if isinstance(value, str):
        return json.dumps(value)
    if not isinstance(value, tuple):
        return repr(value)
    parts = [literal(item, indent + 4) for item in value]
    flat = f"({parts[0]},)" if len(parts) == 1 else f"({', '.join(parts)})"
    if indent + len(flat) < WIDTH - 12:
        return flat
    inner = " " * (indent + 4)
    return "(\n" + "".join(f"{inner}{part},\n" for part in parts) + " " * indent + ")"
