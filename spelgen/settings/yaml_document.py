"""Read YAML files, validate each key, and report errors with their lines.

Unsafe or ambiguous constructs of YAML are errors. This module also defines the types of values in settings files, and
the base class of their groups of keys.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from math import pi
from pathlib import Path
from typing import Annotated, Any, TypeAlias, TypeVar, get_args, get_origin

import yaml
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails
from yaml.composer import ComposerError

from spelgen.errors import SettingsError, collect, suggestion
from spelgen.files import read_bytes

Location: TypeAlias = tuple[int | str, ...]
"""Place of a value in a YAML file: keys, and indices of list items from 0, from the outermost group inwards."""

# {type of an error of pydantic: expected content in plain words}, for types whose message has words of Python.
EXPECTED = {
    "missing": "a value", "model_type": "keys with values", "dict_type": "keys with values", "tuple_type": "a list",
    "list_type": "a list", "too_short": "a longer list", "too_long": "a shorter list", "float_type": "a number",
    "float_parsing": "a number", "int_parsing": "a whole number", "int_from_float": "a whole number",
    "bool_parsing": "true or false", "bool_type": "true or false", "string_type": "a text, in quotes",
    "invalid_key": "a name as key; in braces, write numbers with a decimal point, 1.5",
}  # fmt: skip

# {part of a message about YAML: advice about its most frequent cause}.
YAML_ADVICE = {
    r"'\t'": "write spaces in place of tabs", "an alias": "write the values again", "a second time": "join both",
    "another document": "remove the line ---", "expected ',' or '}'": "write a text with braces in quotes",
    "expected <block end>": "write a text that begins with { or [ in quotes",
}  # fmt: skip
SPACE = "write a space after the colon"

Checked = TypeVar("Checked", bound=BaseModel)
_OCTAL = re.compile("[-+]?0[0-7]+")


@dataclass(frozen=True, eq=False)
class YamlDocument:
    """A parsed YAML file. path: path of the file. root: root of the node tree of PyYAML; None for an empty file."""

    path: Path
    root: yaml.Node | None

    def value(self) -> Any:
        """Return the content of the file as dicts, lists and scalars. Raises SettingsError for an invalid value."""
        if self.root is None:
            return None
        try:
            return yaml.SafeLoader("").construct_document(self.root)
        except yaml.YAMLError as error:
            raise _yaml_error(error, self.path) from error
        # PyYAML raises ValueError, and no YAMLError, for some values such as the date 2025-99-99.
        except ValueError as error:
            raise SettingsError(f"not plain YAML: {error}", file=self.path) from error

    def line(self, location: Location) -> int | None:
        """Return the line of a key or list item; if it is absent, the line of its group. None for an empty file."""
        if self.root is None:
            return None
        node, line = self.root, int(self.root.start_mark.line) + 1
        for key in location:
            entry = _entry(node, key)
            if entry is None:
                break
            name, node = entry
            line = int(name.start_mark.line) + 1
        return line


def _entry(node: yaml.Node, key: int | str) -> tuple[yaml.Node, yaml.Node] | None:
    """Return two nodes of an entry of a YAML mapping or list: the node whose line is reported in errors, and its value.

    For an entry of a mapping, the first node is its key. For an item of a list, both nodes are the item. The result is
    None if the entry does not exist. key: key in a mapping, or index in a list.
    """
    if isinstance(node, yaml.MappingNode):
        for name, value in node.value:
            if name.value == str(key):
                return name, value
    elif isinstance(node, yaml.SequenceNode) and isinstance(key, int) and key < len(node.value):
        return node.value[key], node.value[key]
    return None


class _Loader(yaml.SafeLoader):  # type: ignore[misc]  # PyYAML has no types
    """PyYAML's safe loader; tags, aliases, deep nesting, repeated keys, and numbers such as 1:50 are errors, too."""

    depth = 0

    def compose_node(self, parent: yaml.Node | None, index: object) -> yaml.Node:
        event = self.peek_event()
        mark = event.start_mark
        # Aliases are errors, because aliases of aliases expand a small file to gigabytes.
        if self.check_event(yaml.AliasEvent):
            raise ComposerError(None, None, "an alias", mark)
        is_tagged = isinstance(event, yaml.ScalarEvent | yaml.CollectionStartEvent) and event.tag is not None
        # Tags are errors, because a tag may contradict its value, as in "!!bool maybe".
        if is_tagged:
            raise ComposerError(None, None, f"the tag {event.tag}", mark)
        # The depth of nesting is bounded, because the parser is recursive. Settings have at most six levels.
        if self.depth == 16:
            raise ComposerError(None, None, "more than 16 levels", mark)
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        # YAML 1.1 reads 1:50 as 110 (base 60) and 0100 as 64 (octal): a gear ratio written so would be wrong silently.
        is_number = str(node.tag).endswith((":int", ":float"))
        if is_number and (":" in node.value or _OCTAL.fullmatch(node.value)):
            raise ComposerError(None, None, f"the number {node.value}, which is not decimal", mark)
        return node

    def compose_mapping_node(self, anchor: str | None) -> yaml.Node:
        node = super().compose_mapping_node(anchor)
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise ComposerError(None, None, "a key that is no plain word", key.start_mark)
            # A repeated key is an error, because PyYAML would silently use its last value.
            if key.value in seen:
                raise ComposerError(None, None, f"the key {key.value!r} a second time", key.start_mark)
            seen.add(key.value)
        return node


def read_document(path: Path) -> YamlDocument:
    """Read and parse a YAML file; its keys and values are not yet validated.

    Raises SettingsError if the file cannot be read, is larger than 256 KiB, or is not one valid YAML document in UTF-8.
    Tags, aliases, repeated keys, deep nesting, and numbers such as 1:50 are also errors.
    """
    # The size of a YAML file is bounded, because larger files could exhaust the memory. Settings of 300 joints with all
    # keys have 60 kB.
    content = read_bytes(path, SettingsError, "a YAML file", 256 * 1024)
    try:
        return YamlDocument(path, _Loader(content.decode("utf-8")).get_single_node())
    except UnicodeDecodeError as error:
        raise SettingsError("bytes that are not UTF-8", file=path, expected="YAML text") from error
    except yaml.YAMLError as error:
        raise _yaml_error(error, path) from error


def _yaml_error(error: yaml.YAMLError, path: Path) -> SettingsError:
    problem, mark = "characters that YAML does not allow", None
    if isinstance(error, yaml.MarkedYAMLError) and error.problem:
        # Some messages of PyYAML begin with "but", since they are the second half of a sentence. The word is removed.
        problem, mark = error.problem.removeprefix("but "), error.problem_mark
    do = next((advice for text, advice in YAML_ADVICE.items() if text in problem), None)
    return SettingsError(f"not plain YAML: {problem}", file=path, line=mark.line + 1 if mark else None, do=do)


def validated(group: type[Checked], content: object, document: YamlDocument | None = None) -> Checked:
    """Return an object of the class `group` with validated values.

    Raises SettingsError, or SpelgenErrors for several errors; see `explain`.

    Args:
        group: Class of the group.
        content: Content of a YAML file, or a dict of arguments; None: all values are defaults.
        document: The YAML file, for the lines in errors; None if the content is not from a file.
    """
    try:
        return group.model_validate({} if content is None else content)
    except ValidationError as error:
        collect([explain(detail, document, group) for detail in error.errors(include_url=False)])
        raise


def explain(detail: ErrorDetails, document: YamlDocument | None, group: type[BaseModel]) -> SettingsError:
    """Return one error of pydantic as a `SettingsError` with line and expected value.

    detail: an item of pydantic's `ValidationError.errors`. document: the YAML file; None for values of the command
    line, which have no lines. group: class of the settings.
    """
    location, error_type = detail["loc"], detail["type"]
    parent = _group_at(group, location[:-1]).model_fields
    # An unknown key, the most frequent error, is in a wrong group, or misspelt: the message names the groups that have
    # it, or the most similar known key.
    if error_type == "extra_forbidden":
        error = unknown_name(location, "key", str(location[-1]), parent, document)
        groups = " or ".join(_groups_with(group, location))
        error.do = f"write it {groups}" if groups else SPACE if ":" in str(location[-1]) else error.do
        return error
    message = detail["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    expected = EXPECTED.get(error_type, message)
    items = get_args(parent[str(location[-1])].annotation) if location and str(location[-1]) in parent else ()
    if error_type == "tuple_type" and items and ... not in items:
        expected = f"a list of {len(items)} numbers"
    # Pydantic adds "[key]" to the location of an invalid key of a dict: it is removed.
    if location[-1:] == ("[key]",):
        location, expected = location[:-1], "a name; write it in quotes"
        if error_type == "string_pattern_mismatch":
            expected = "a name of letters, digits, '.', '_' and '-'"
    got = repr(detail["input"])
    if error_type == "missing" and isinstance(detail["input"], Mapping):
        got = "nothing"
    elif error_type == "value_error" and not location:
        got = "these settings"
    if len(got) > 60:
        got = got[:57] + "..."
    error = _error_at(location, document, got)
    error.expected = expected
    got_text = detail["input"] if isinstance(detail["input"], str) else ""
    if ":" in (str(location[-1]) if location else got_text):
        error.do = SPACE
    elif re.match(r"[-+]?\.?\d", got_text):
        error.do = "write the number only, with a decimal point; docs/settings.md has its unit"
    return error


def unknown_name(
    location: Location, noun: str, name: str, names: Iterable[str], document: YamlDocument | None
) -> SettingsError:
    """Return the error for a name that is not among `names`; it suggests the most similar known name.

    noun: "key" or "joint", for the message. location: keys from the root of ``document`` to the name. document: the
    YAML file; None if the name is not from a file.
    """
    error = _error_at(location, document, f"unknown {noun} {name!r}")
    error.element, error.do = dotted(location[:-1]), suggestion(name, names)
    return error


def dotted(location: Location) -> str | None:
    """Return a location in a file as text such as `joints.joint1.gear`; None for the whole file."""
    return ".".join(map(str, location)) or None


def _error_at(location: Location, document: YamlDocument | None, got: str) -> SettingsError:
    if document is None:
        return SettingsError(got, element=dotted(location))
    return SettingsError(got, file=document.path, line=document.line(location), element=dotted(location))


def _group_at(group: type[BaseModel], location: Location) -> type[BaseModel]:
    """Return the class of the group of settings at a location, for a document whose root has the class `group`.

    Elements of the location that are keys of dicts or indices of lists have no class and are skipped.
    """
    for key in map(str, location):
        if key in group.model_fields:
            group = _first_group(group.model_fields[key].annotation) or group
    return group


def _groups_with(group: type[BaseModel], location: Location) -> list[str]:
    """Return the groups in which a misplaced key is valid, as texts for its error, such as "under 'logs'".

    location: path of the key, which ends with the key. The search starts in the group that contains the key, with all
    groups inside it, and continues with each enclosing group up to the root until a group has such a key. Of several
    groups with the key, only the groups with the shortest path are returned; [] if no group has it. group: class of the
    document's root.
    """
    paths: list[Location] = []
    level = len(location)
    while level and not paths:
        level -= 1
        groups = _groups(_group_at(group, location[:level]), location[:level])
        paths = [path for path, x in groups if location[-1] in x.model_fields]
    depth = min(map(len, paths), default=0)
    return [f"under {dotted(x)!r}" if x else "without indentation" for x in paths if len(x) == depth]


def _groups(group: type[BaseModel], path: Location) -> Iterator[tuple[Location, type[BaseModel]]]:
    """Yield (path, class) of a group of settings and of all groups inside it. path: location of the group."""
    yield path, group
    for name, field in group.model_fields.items():
        inner = _first_group(field.annotation)
        if inner:
            yield from _groups(inner, (*path, name, *["NAME"] * (get_origin(field.annotation) is dict)))


def _first_group(annotation: object) -> type[BaseModel] | None:
    """Return the first class of settings in a type annotation such as `dict[str, JointLog] | None`, if any."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next(filter(None, map(_first_group, get_args(annotation))), None)


# Largest magnitude of a number in settings. With this bound, products of several numbers do not overflow.
MAX_MAGNITUDE = 1e12


def no_bool(value: object) -> object:
    """Return the value of a number in settings, unchanged. Raises ValueError if it is a bool."""
    # YAML reads `yes` as True, and float(True) is 1.0: without this check `yes` would be accepted as a number.
    if isinstance(value, bool):
        raise ValueError("a number")
    return value


def bounded(value: float) -> float:
    """Return a number in settings, unchanged. Raises ValueError if its magnitude exceeds MAX_MAGNITUDE."""
    if abs(value) > MAX_MAGNITUDE:
        raise ValueError(f"a number within +-{MAX_MAGNITUDE:g}")
    return value


def in_si(value: float) -> float:
    """Return a position in settings, unchanged. Raises ValueError if it is probably in degrees or mm."""
    # A joint of an arm turns less than four times, and positions in radians are rarely whole numbers.
    if abs(value) > 8 * pi and value == round(value):
        raise ValueError("rad or m, and not degrees or mm")
    return value


Number = Annotated[float, BeforeValidator(no_bool), Field(allow_inf_nan=False), AfterValidator(bounded)]
Place = Annotated[Number, AfterValidator(in_si)]
Positive = Annotated[Number, Field(gt=0)]
NonNegative = Annotated[Number, Field(ge=0)]
Share = Annotated[Number, Field(ge=0, lt=1)]
Whole = Annotated[int, BeforeValidator(no_bool), Field(ge=0)]
Count = Annotated[int, BeforeValidator(no_bool), Field(ge=1)]
Inputs = Annotated[tuple[Number, ...], Field(min_length=1)]


class Group(BaseModel):
    """Base class of a group of keys in a settings file. A derived class has a field per key; other keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)
