"""Read YAML with the line of each value; unsafe or ambiguous constructs of YAML are errors."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import yaml
from yaml.composer import ComposerError

from spelgen.errors import SettingsError
from spelgen.files import read_bytes

Location: TypeAlias = tuple[int | str, ...]
"""Keys and numbers of list items that lead to a place in a file."""

MAX_BYTES = 256 * 1024  # 300 joints, each with every key, take 60 kB
MAX_DEPTH = 16


@dataclass(frozen=True, eq=False)
class YamlDocument:
    """A YAML file and its node tree, None for an empty file."""

    path: Path
    root: yaml.Node | None

    def value(self) -> Any:
        """Return the file's content as dicts, lists and scalars. Raises SettingsError for an invalid date."""
        if self.root is None:
            return None
        try:
            return yaml.SafeLoader("").construct_document(self.root)
        except yaml.YAMLError as error:
            raise _yaml_error(error, self.path) from error
        except ValueError as error:  # e.g. the date 2025-99-99
            raise SettingsError(f"not plain YAML: {error}", file=self.path) from error

    def line(self, location: Location) -> int | None:
        """Return the line of a key or list item, or of the innermost existing group that would contain it."""
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
    """Return the nodes of a key and of its value, or the node of a list item twice; None if it does not exist."""
    if isinstance(node, yaml.MappingNode):
        for name, value in node.value:
            if name.value == str(key):
                return name, value
    elif isinstance(node, yaml.SequenceNode) and isinstance(key, int) and key < len(node.value):
        return node.value[key], node.value[key]
    return None


class _Loader(yaml.SafeLoader):  # type: ignore[misc]  # PyYAML has no types
    """The safe loader, without tags, aliases (a small file could grow huge), deep nesting and repeated keys."""

    depth = 0

    def compose_node(self, parent: yaml.Node | None, index: object) -> yaml.Node:
        event = self.peek_event()
        mark = event.start_mark
        if self.check_event(yaml.AliasEvent):
            raise ComposerError(None, None, "an alias", mark)
        is_tagged = isinstance(event, yaml.ScalarEvent | yaml.CollectionStartEvent) and event.tag is not None
        if is_tagged:  # a tag may contradict its value, as in "!!bool maybe"
            raise ComposerError(None, None, f"the tag {event.tag}", mark)
        if self.depth == MAX_DEPTH:
            raise ComposerError(None, None, f"more than {MAX_DEPTH} levels", mark)
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def compose_mapping_node(self, anchor: str | None) -> yaml.Node:
        node = super().compose_mapping_node(anchor)
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise ComposerError(None, None, "a key that is no plain word", key.start_mark)
            if key.value in seen:
                raise ComposerError(None, None, f"the key {key.value!r} a second time", key.start_mark)
            seen.add(key.value)
        return node


def read_document(path: Path) -> YamlDocument:
    """Return the content of a small YAML file with one document. Raises SettingsError for any other file."""
    content = read_bytes(path, SettingsError, "a YAML file", MAX_BYTES)
    try:
        return YamlDocument(path, _Loader(content.decode("utf-8")).get_single_node())
    except UnicodeDecodeError as error:
        raise SettingsError("bytes that are not UTF-8", file=path, expected="YAML text") from error
    except yaml.YAMLError as error:
        raise _yaml_error(error, path) from error


def _yaml_error(error: yaml.YAMLError, path: Path) -> SettingsError:
    problem, mark = "characters that YAML does not allow", None
    if isinstance(error, yaml.MarkedYAMLError) and error.problem:
        # PyYAML begins the second half of some sentences with "but"
        problem, mark = error.problem.removeprefix("but "), error.problem_mark
    return SettingsError(f"not plain YAML: {problem}", file=path, line=mark.line + 1 if mark else None)
