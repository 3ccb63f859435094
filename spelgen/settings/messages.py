"""Errors of a settings file, with file, line and key."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TypeVar, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from spelgen.errors import SettingsError, collect, suggestion
from spelgen.settings.yaml_document import Location, YamlDocument

MAX_VALUE_LENGTH = 60  # characters of a value in a message
EXPECTED = {"missing": "a value", "model_type": "keys with values", "dict_type": "keys with values"}

Checked = TypeVar("Checked", bound=BaseModel)


def validated(group: type[Checked], content: object, document: YamlDocument | None = None) -> Checked:
    """Return the content of a file, or arguments of a caller, as a group of settings; None: the defaults.

    Raises SettingsError, or SpelgenErrors for several errors; see `explain`.
    """
    try:
        return group.model_validate({} if content is None else content)
    except ValidationError as error:
        collect([explain(detail, document, group) for detail in error.errors(include_url=False)])
        raise


def explain(detail: ErrorDetails, document: YamlDocument | None, group: type[BaseModel]) -> SettingsError:
    """Return one of pydantic's `ValidationError.errors` as an error with its line and the expected value.

    document: None for values of the command line, which have no lines.
    """
    location, error_type = detail["loc"], detail["type"]
    if error_type == "extra_forbidden":
        names = _group_at(group, location[:-1]).model_fields
        return unknown_name(location, "key", str(location[-1]), names, document)
    expected = EXPECTED.get(error_type) or detail["msg"].removeprefix("Input should be ").removeprefix(
        "Value error, "
    )
    # this is pydantic's location of an invalid key of a dict
    if location[-1:] == ("[key]",):
        location, expected = location[:-1], "a name; write it in quotes"
        if error_type == "string_pattern_mismatch":
            expected = "a name of letters, digits, '.', '_' and '-'"
    got = repr(detail["input"])
    if error_type == "missing" and isinstance(detail["input"], Mapping):
        got = "nothing"
    elif error_type == "value_error" and not location:
        got = "these settings"
    if len(got) > MAX_VALUE_LENGTH:
        got = got[: MAX_VALUE_LENGTH - 3] + "..."
    error = _error_at(location, document, got)
    error.expected = expected
    return error


def unknown_name(
    location: Location, noun: str, name: str, names: Iterable[str], document: YamlDocument | None
) -> SettingsError:
    """Return the error for a name that is not among `names`, with the nearest known name; noun: key or joint."""
    error = _error_at(location, document, f"unknown {noun} {name!r}")
    error.element, error.do = dotted(location[:-1]), suggestion(name, names)
    return error


def dotted(location: Location) -> str | None:
    """Return the location in a file as `joints.joint1.gear`; None for the whole file."""
    return ".".join(map(str, location)) or None


def _error_at(location: Location, document: YamlDocument | None, got: str) -> SettingsError:
    if document is None:
        return SettingsError(got, element=dotted(location))
    return SettingsError(got, file=document.path, line=document.line(location), element=dotted(location))


def _group_at(group: type[BaseModel], location: Location) -> type[BaseModel]:
    """Return the group of keys at a location; the location may contain keys of dicts and indices of lists."""
    for key in location:
        field = group.model_fields.get(str(key))
        if field is not None:
            group = _first_group(field.annotation) or group
    return group


def _first_group(annotation: object) -> type[BaseModel] | None:
    """Return the first group of keys in an annotation such as `dict[str, Group] | None`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in get_args(annotation):
        group = _first_group(argument)
        if group is not None:
            return group
    return None
