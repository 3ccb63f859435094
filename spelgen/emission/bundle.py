"""The parts of ``spelgen/runtime`` that a module uses, and the imports they need."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from graphlib import TopologicalSorter
from importlib.resources import files

_OURS = "spelgen.runtime."


@dataclass(frozen=True)
class Definition:
    """A class, function or constant of the runtime: its text, comments above it included, and the names it uses."""

    text: str
    uses: frozenset[str]
    is_block: bool  # a class or function, not a constant


@dataclass(frozen=True)
class Runtime:
    """Hold all of the runtime.

    definitions: by name, in an order in which they can be executed. imports: by the name that they bind.
    """

    definitions: dict[str, Definition]
    imports: dict[str, str]


def bundle(tailored: str, kinds: Mapping[str, str]) -> tuple[str, str]:
    """Return the imports, and the runtime's definitions, that the source text ``tailored`` needs.

    ``kinds``: the runtime's class by kind of part, such as MaskedMLP for Network. A module has one class of each kind,
    which therefore has the kind's name there.
    """
    runtime = load_runtime()
    tree = ast.parse(tailored)
    defined_here = {*map(_defined, tree.body), *kinds}
    used = names_in(tree) | set(kinds.values())
    pending = list(used)
    while pending:
        name = pending.pop()
        if name in defined_here or name not in runtime.definitions:
            continue
        new = runtime.definitions[name].uses - used
        used |= new
        pending += new
    text, previous_is_block = "", True
    for name, definition in runtime.definitions.items():
        if name in used and name not in defined_here:
            # constants stand line below line, as a person writes them
            separate = definition.is_block or previous_is_block
            text += ("\n\n\n" if separate else "\n") + definition.text
            previous_is_block = definition.is_block
    for kind, name in kinds.items():
        text = re.sub(rf"\b{name}\b", kind, text)
    return _imports(used, runtime.imports), text.strip()


@cache
def load_runtime() -> Runtime:
    """Read the runtime's source."""
    texts: dict[str, str] = {}
    trees: dict[str, ast.Module] = {}
    order: TopologicalSorter[str] = TopologicalSorter()
    for path in sorted((files("spelgen") / "runtime").iterdir(), key=lambda path: path.name):
        name = path.name.removesuffix(".py")
        if path.name.endswith(".py") and name != "__init__":
            texts[name] = path.read_text(encoding="utf-8")
            trees[name] = ast.parse(texts[name])
            order.add(name, *_needs(trees[name]))
    runtime = Runtime({}, {})
    for name in order.static_order():
        for node in trees[name].body:
            if isinstance(node, ast.Import | ast.ImportFrom):
                runtime.imports.update(_bound(node))
            elif (defined := _defined(node)) is not None:
                uses = frozenset(names_in(node))
                runtime.definitions[defined] = Definition(
                    _text(node, texts[name]), uses, not isinstance(node, ast.Assign)
                )
    return runtime


def names_in(tree: ast.AST) -> set[str]:
    """Every name that is read in a tree, annotations included."""
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}


def _needs(tree: ast.Module) -> list[str]:
    """The runtime files that a file imports from, in a stable order."""
    needs = []
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(_OURS):
            needs.append((node.module or "").removeprefix(_OURS))
    return sorted(needs)


def _bound(node: ast.Import | ast.ImportFrom) -> dict[str, str]:
    """What an import of something outside the runtime binds: the statement, by name."""
    start = ""
    if isinstance(node, ast.ImportFrom):
        module = node.module or ""
        if module.startswith(_OURS) or module == "__future__":
            return {}
        start = f"from {module} "
    bound = {}
    for alias in node.names:
        statement = f"{start}import {alias.name}"
        if alias.asname:
            statement += f" as {alias.asname}"
        bound[alias.asname or alias.name] = statement
    return bound


def _defined(node: ast.stmt) -> str | None:
    """The name that a statement at the top of a file defines."""
    if isinstance(node, ast.ClassDef | ast.FunctionDef):
        return node.name
    if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
        return node.targets[0].id
    return None


def _text(node: ast.stmt, source: str) -> str:
    """A statement's lines, with the comment right above it; no definition of the runtime has a decorator."""
    lines = source.splitlines()
    first = node.lineno - 1
    while first and lines[first - 1].startswith("#"):
        first -= 1
    return "\n".join(lines[first : node.end_lineno])


def _imports(used: Iterable[str], imports: dict[str, str]) -> str:
    """The imports of the used names, the standard library's first, then torch's, sorted as an import sorter does."""
    plain: set[str] = set()
    members: dict[str, str] = {}
    for name in sorted(set(imports).intersection(used)):
        module, _, imported = imports[name].partition(" import ")
        if not imported:
            plain.add(imports[name])
        elif module in members:
            members[module] += f", {imported}"
        else:
            members[module] = f"{module} import {imported}"
    groups: dict[bool, list[str]] = {False: [], True: []}
    for statement in [*sorted(plain), *sorted(members.values())]:
        groups["torch" in statement].append(statement)
    return "\n\n".join("\n".join(group) for group in groups.values() if group)
