"""The part of ``spelgen.runtime`` that a standalone module contains, and the imports that it needs."""

from __future__ import annotations

import ast
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from graphlib import TopologicalSorter
from importlib.resources import files
from typing import NamedTuple

_OURS = "spelgen.runtime."


@dataclass(frozen=True)
class Definition:
    """A class, function or constant of the runtime: its text with comments, and the names that it uses."""

    text: str
    uses: frozenset[str]
    is_block: bool  # a class or function, not a constant


@dataclass(frozen=True)
class Runtime:
    """The source of the runtime.

    definitions: by name, each after the definitions that its execution needs. imports: statements by the name that they
    bind. rows: names of the definitions that the rows of an arm need. public: names that a module imports.
    """

    definitions: dict[str, Definition]
    imports: dict[str, str]
    rows: frozenset[str]
    public: frozenset[str]


class Bundle(NamedTuple):
    """The runtime that a standalone module contains: import statements, definitions before and after the arm."""

    imports: str
    rows: str
    runtime: str
    contents: tuple[str, ...]  # names of the classes and functions of the runtime


def bundle(arm: str, model: str) -> Bundle:
    """Return the part of the runtime that the source texts of an arm and its model need."""
    runtime = load_runtime()
    used = names_in(ast.parse(f"{arm}\n{model}"))
    pending = list(used)
    while pending:
        name = pending.pop()
        if name in runtime.definitions:
            new = runtime.definitions[name].uses - used
            used |= new
            pending += new
    names = [name for name in runtime.definitions if name in used]
    # classes of the rows are defined before the rows, all other definitions after the arm
    row_names = [name for name in names if name in runtime.rows]
    model_names = [name for name in names if name not in runtime.rows]
    blocks = tuple(name for name in model_names if runtime.definitions[name].is_block)
    rows, definitions = _joined(runtime, row_names), _joined(runtime, model_names)
    return Bundle(_imports(used, runtime.imports), rows, definitions, blocks)


def _joined(runtime: Runtime, names: Iterable[str]) -> str:
    """Return these definitions, constants on consecutive lines."""
    text, previous_is_block = "", True
    for name in names:
        definition = runtime.definitions[name]
        separate = definition.is_block or previous_is_block
        text += ("\n\n\n" if separate else "\n") + definition.text
        previous_is_block = definition.is_block
    return text.strip()


@cache
def load_runtime() -> Runtime:
    """Read the source of the runtime."""
    texts: dict[str, str] = {}
    trees: dict[str, ast.Module] = {}
    order: TopologicalSorter[str] = TopologicalSorter()
    public: set[str] = set()
    for path in sorted((files("spelgen") / "runtime").iterdir(), key=lambda path: path.name):
        name = path.name.removesuffix(".py")
        if not path.name.endswith(".py"):
            continue
        texts[name] = path.read_text(encoding="utf-8")
        if name == "__init__":
            imported = [node for node in ast.parse(texts[name]).body if isinstance(node, ast.ImportFrom)]
            public = {alias.name for node in imported for alias in node.names}
            continue
        trees[name] = ast.parse(texts[name])
        order.add(name, *_needs(trees[name]))
    definitions: dict[str, Definition] = {}
    imports: dict[str, str] = {}
    for name in order.static_order():
        for node in trees[name].body:
            if isinstance(node, ast.Import | ast.ImportFrom):
                imports.update(_bound(node))
            elif (defined := _defined(node)) is not None:
                uses = frozenset(names_in(node))
                definitions[defined] = Definition(
                    _text(node, texts[name]), uses, not isinstance(node, ast.Assign)
                )
    rows = frozenset(filter(None, map(_defined, trees["rows"].body)))
    return Runtime(definitions, imports, rows, frozenset(public))


def names_in(tree: ast.AST) -> set[str]:
    """Return every name that is used in a tree, annotations included."""
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}


def _needs(tree: ast.Module) -> list[str]:
    """Return the runtime files that a file imports from, sorted."""
    needs = []
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(_OURS):
            needs.append((node.module or "").removeprefix(_OURS))
    return sorted(needs)


def _bound(node: ast.Import | ast.ImportFrom) -> dict[str, str]:
    """Return the names that an import from outside the runtime binds, with their statements."""
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
    """Return the name that a statement at the top of a file defines; None for other statements."""
    if isinstance(node, ast.ClassDef | ast.FunctionDef):
        return node.name
    if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
        return node.targets[0].id
    return None


def _text(node: ast.stmt, source: str) -> str:
    """Return the lines of a statement and the comment above it; no definition of the runtime has a decorator."""
    lines = source.splitlines()
    first = node.lineno - 1
    while first and lines[first - 1].startswith("#"):
        first -= 1
    return "\n".join(lines[first : node.end_lineno])


def _imports(used: Iterable[str], imports: dict[str, str]) -> str:
    """Return the imports of the used names, from the standard library and then torch, sorted as ruff sorts them."""
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
