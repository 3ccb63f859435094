"""Python source text of values (calls, tuples, dictionaries, numbers, texts), broken into readable lines."""

import ast
import json

from spelgen.emission.parts import Call, Code

WIDTH = 110
_STEP = 4  # blanks per level of indentation
SKIP = "  # fmt: skip"  # With this comment in a module, ruff does not reformat its rows of numbers.


def filled(start: str, value: object, indent: int, reserved: int = 0) -> str:
    """Return the text ``start`` followed by the source text of ``value``, in one line or several lines.

    The result is one line if the text and ``reserved`` more characters fit into ``WIDTH`` columns.

    Args:
        start: text before the value, such as "name=".
        value: the value.
        indent: column at which the text starts.
        reserved: number of characters that the caller adds after the text, such as a comment.
    """
    text = start + flat(value)
    if indent + len(text) + reserved < WIDTH or not _items(value) or _is_repeated(value):
        return text
    inner = " " * (indent + _STEP)
    opening, closing = "{}" if isinstance(value, dict) else "()"
    callee = value.callee if isinstance(value, Call) else ""
    # Each line is filled with as many items as fit. An item that has several lines starts on its own line.
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
    """Return ``start`` followed by the source text of a call with one line per argument; indent: column of the call."""
    inner = " " * (indent + _STEP)
    lines = [f"{inner}{filled(key, item, indent + _STEP)}," for key, item in _items(value)]
    return "\n".join([f"{start}{value.callee}(", *lines, " " * indent + ")"])


def flat(value: object) -> str:
    """Return the source text of a value in one line. Texts become string literals of ASCII characters."""
    if isinstance(value, Code):
        return value.text
    if isinstance(value, str):
        return json.dumps(value) if value.isascii() and value.isprintable() else ascii(value)
    if isinstance(value, tuple):
        if _is_repeated(value):
            return f"({flat(value[0])},) * {len(value)}"
        return f"({flat(value[0])},)" if len(value) == 1 else f"({_joined(value)})"
    if isinstance(value, dict):
        return "{" + _joined(value) + "}"
    return f"{value.callee}({_joined(value)})" if isinstance(value, Call) else repr(value)


def _items(value: object) -> list[tuple[str, object]]:
    """Return (prefix, item) for each argument of a ``Call``, or item of a dictionary or tuple; [] for other values.

    The prefix is "key=" for a keyword argument of a call, "key: " for a dictionary, otherwise "".
    """
    if isinstance(value, Call):
        return [(f"{key}=" if key else "", item) for key, item in value.arguments]
    if isinstance(value, dict):
        return [(f"{flat(key)}: ", item) for key, item in value.items()]
    return [("", item) for item in value] if isinstance(value, tuple) else []


def _is_repeated(value: object) -> bool:
    """Return True for a tuple of more than three equal items, which is written as a product: ``(0.0,) * 6``."""
    return isinstance(value, tuple) and len(value) > 3 and value.count(value[0]) == len(value)


def _joined(value: object) -> str:
    return ", ".join(key + flat(item) for key, item in _items(value))


def names_in(tree: ast.AST) -> set[str]:
    """Return all names that occur in a syntax tree, including names in annotations."""
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
