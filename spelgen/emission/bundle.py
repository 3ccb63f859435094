"""The parts of the runtime that a module uses, as they stand in ``spelgen/runtime``, and the imports they need."""

from __future__ import annotations

import ast
from collections.abc import Iterable
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


@dataclass(frozen=True)
class Runtime:
    """All of the runtime. definitions: by name, in an order in which they can be executed. imports: by the name
    that they bind.
    """

    definitions: dict[str, Definition]
    imports: dict[str, str]


def bundle(tailored: str) -> tuple[str, str]:
    """Return the imports, and the runtime's definitions, that the source text ``tailored`` needs."""
    runtime = load_runtime()
    tree = ast.parse(tailored)
    # a kind of part, such as Network, is in a module the class of its own part
    defined_here = {_defined(node) for node in tree.body}
    used = names_in(tree)
    waiting = list(used)
    while waiting:
        name = waiting.pop()
        if name in defined_here or name not in runtime.definitions:
            continue
        new = runtime.definitions[name].uses - used
        used |= new
        waiting += new
    texts = []
    for name, definition in runtime.definitions.items():
        if name in used and name not in defined_here:
            texts.append(definition.text)
    return _imports(used, runtime.imports), "\n\n\n".join(texts)


@cache
def load_runtime() -> Runtime:
    """Read the runtime's source."""
    folder = files("spelgen") / "runtime"
    texts = {
        path.name.removesuffix(".py"): path.read_text(encoding="utf-8")
        for path in sorted(folder.iterdir(), key=lambda path: path.name)
        if path.name.endswith(".py") and path.name != "__init__.py"
    }
    trees = {name: ast.parse(text) for name, text in texts.items()}
    definitions: dict[str, Definition] = {}
    imports: dict[str, str] = {}
    for name in TopologicalSorter({name: _needs(tree) for name, tree in trees.items()}).static_order():
        for node in trees[name].body:
            if isinstance(node, ast.Import | ast.ImportFrom):
                imports |= _bound(node)
            elif (defined := _defined(node)) is not None:
                definitions[defined] = Definition(_text(node, texts[name]), frozenset(names_in(node)))
    return Runtime(definitions, imports)


def names_in(tree: ast.AST) -> set[str]:
    """Every name that is read in a tree, annotations included."""
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}


def _needs(tree: ast.Module) -> list[str]:
    """The runtime files that a file imports from, in a stable order."""
    modules = [node.module for node in tree.body if isinstance(node, ast.ImportFrom) and node.module]
    return sorted(module.removeprefix(_OURS) for module in modules if module.startswith(_OURS))


def _bound(node: ast.Import | ast.ImportFrom) -> dict[str, str]:
    """What an import of something outside the runtime binds."""
    if isinstance(node, ast.Import):
        return {
            alias.asname or alias.name: f"import {alias.name}"
            + (f" as {alias.asname}" if alias.asname else "")
            for alias in node.names
        }
    module = node.module or ""
    if module.startswith(_OURS) or module == "__future__":
        return {}
    return {alias.name: f"from {module} import" for alias in node.names}


def _defined(node: ast.stmt) -> str | None:
    """The name that a statement at the top of a file defines."""
    if isinstance(node, ast.ClassDef | ast.FunctionDef):
        return node.name
    if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
        return node.targets[0].id
    return None


def _text(node: ast.stmt, source: str) -> str:
    """A statement's lines, with decorators and with the comment right above it."""
    lines = source.splitlines()
    decorators = getattr(node, "decorator_list", [])
    first = min([node.lineno, *(node_above.lineno for node_above in decorators)]) - 1
    while first and lines[first - 1].startswith("#"):
        first -= 1
    return "\n".join(lines[first : node.end_lineno])


def _imports(used: Iterable[str], imports: dict[str, str]) -> str:
    """The imports of the used names, the standard library's first, then torch's, sorted as an import sorter does."""
    members: dict[str, list[str]] = {}
    plain = []
    for name in sorted(used):
        statement = imports.get(name)
        if statement is None:
            continue
        if statement.startswith("from "):
            members.setdefault(statement, []).append(name)
        else:
            plain.append(statement)
    lines = [*sorted(plain), *(f"{start} {', '.join(names)}" for start, names in sorted(members.items()))]
    groups = [[line for line in lines if ("torch" in line) == torch] for torch in (False, True)]
    return "\n\n".join("\n".join(group) for group in groups if group)
