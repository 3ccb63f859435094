"""What is wrong in a settings file, told with file, line and key."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, get_args

from pydantic import BaseModel

from spelgen.errors import SettingsError, suggestion
from spelgen.settings.yaml_document import Document


def explain(detail: Mapping[str, Any], document: Document, group: type[BaseModel]) -> SettingsError:
    """What pydantic found wrong (one of `ValidationError.errors`), with its line and what was expected there."""
    location, kind = tuple(detail["loc"]), detail["type"]
    if kind == "extra_forbidden":
        known = list(_group_at(group, location[:-1]).model_fields)
        return unknown_name(location, "key", str(location[-1]), known, document)
    if location[-1:] == ("[key]",):
        location, kind = location[:-1], "name" if kind == "string_pattern_mismatch" else "key"
    expected = {
        "key": "a name; write it in quotes",
        "name": "a name of letters, digits, '.', '_' and '-'",
        "missing": "a value",
        "model_type": "keys with values",
        "dict_type": "keys with values",
    }.get(kind, detail["msg"].removeprefix("Input should be ").removeprefix("Value error, "))
    got = repr(detail["input"]) if location or kind != "value_error" else "these settings"
    if kind == "missing" and isinstance(detail["input"], Mapping):
        got = "nothing"
    return SettingsError(
        got if len(got) <= 60 else got[:57] + "...",
        file=document.path,
        line=document.line(location),
        element=_dotted(location),
        expected=expected,
    )


def _group_at(group: type[BaseModel], location: tuple[Any, ...]) -> type[BaseModel]:
    """The group of keys at a place in a file; keys of a dict and numbers of a list lead into the next one."""
    for part in location:
        field = group.model_fields.get(str(part))
        group = next(iter(_groups_in(field.annotation)), group) if field else group
    return group


def _groups_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [found for each in get_args(annotation) for found in _groups_in(each)]


def unknown_name(
    location: tuple[Any, ...], kind: str, name: str, known: Iterable[str], document: Document
) -> SettingsError:
    """A name that a file speaks of and nothing has, with the known name that is closest."""
    return SettingsError(
        f"unknown {kind} {name!r}",
        file=document.path,
        line=document.line(location),
        element=_dotted(location[:-1]),
        do=suggestion(name, known),
    )


def _dotted(location: tuple[Any, ...]) -> str | None:
    return ".".join(map(str, location)) or None
