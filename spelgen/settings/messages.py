"""Say what is wrong in a settings file, with file, line and key."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from spelgen.errors import SettingsError, collect, suggestion
from spelgen.settings.yaml_document import Document, Location

LONGEST_VALUE = 60  # characters of a value that a message repeats
EXPECTED = {
    "missing": "a value",
    "model_type": "keys with values",
    "dict_type": "keys with values",
}

Checked = TypeVar("Checked", bound=BaseModel)


def validated(group: type[Checked], content: object, document: Document | None = None) -> Checked:
    """Return what a file or a caller says as a group of settings, the defaults of None.

    Raises SettingsError, or SpelgenErrors with all that is wrong; see `explain`.
    """
    try:
        return group.model_validate({} if content is None else content)
    except ValidationError as error:
        collect([explain(detail, document, group) for detail in error.errors(include_url=False)])
        raise


def explain(detail: Mapping[str, Any], document: Document | None, group: type[BaseModel]) -> SettingsError:
    """Return one of pydantic's `ValidationError.errors` as an error with its line and what was expected there.

    document: None for values of the command line, which have no lines.
    """
    location, kind = tuple(detail["loc"]), detail["type"]
    if kind == "extra_forbidden":
        names = _group_at(group, location[:-1]).model_fields
        return unknown_name(location, "key", str(location[-1]), names, document)
    expected = EXPECTED.get(kind) or detail["msg"].removeprefix("Input should be ").removeprefix(
        "Value error, "
    )
    # pydantic has this place for a key of a dict that is none
    if location[-1:] == ("[key]",):
        location, expected = location[:-1], "a name; write it in quotes"
        if kind == "string_pattern_mismatch":
            expected = "a name of letters, digits, '.', '_' and '-'"
    got = repr(detail["input"])
    if kind == "missing" and isinstance(detail["input"], Mapping):
        got = "nothing"
    elif kind == "value_error" and not location:
        got = "these settings"
    # a list of a thousand numbers would bury the message
    if len(got) > LONGEST_VALUE:
        got = got[: LONGEST_VALUE - 3] + "..."
    return SettingsError(got, expected=expected, **_place(location, document))


def unknown_name(
    location: Location, kind: str, name: str, names: Iterable[str], document: Document | None
) -> SettingsError:
    """Return the error for a name that a file speaks of and nothing has, with the known name that is closest."""
    fields = _place(location, document)
    fields["element"] = dotted(location[:-1])
    return SettingsError(f"unknown {kind} {name!r}", do=suggestion(name, names), **fields)


def dotted(location: Location) -> str | None:
    """Return the place in a file as `joints.joint1.gear`; None for the whole file."""
    return ".".join(map(str, location)) or None


def _place(location: Location, document: Document | None) -> dict[str, Any]:
    if document is None:
        return {"element": dotted(location)}
    return {"file": document.path, "line": document.line(location), "element": dotted(location)}


def _group_at(group: type[BaseModel], location: Location) -> type[BaseModel]:
    """Return the group of keys at a place in a file; keys of a dict and numbers of a list lead into the next one."""
    for key in location:
        field = group.model_fields.get(str(key))
        if field is not None:
            group = _first_group(field.annotation) or group
    return group


def _first_group(annotation: object) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in get_args(annotation):
        group = _first_group(argument)
        if group is not None:
            return group
    return None
