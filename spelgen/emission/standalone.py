"""Source of the runtime in standalone modules: the definitions of ``spelgen.runtime`` that a model needs."""

import ast
from collections import defaultdict
from collections.abc import Iterable
from functools import cache
from graphlib import TopologicalSorter
from importlib.resources import files
from typing import NamedTuple

from spelgen.emission.text import names_in

_OURS = "spelgen.runtime."


class Definition(NamedTuple):
    """A class, function or constant of the runtime."""

    text: str  # source text with comments
    uses: frozenset[str]  # names that occur in the text
    is_block: bool  # True for a class or function, False for a constant
    file: str  # name of the file, without the suffix


class Runtime(NamedTuple):
    """The source of all files of ``spelgen.runtime``."""

    definitions: dict[str, Definition]  # {name: definition}, each after the definitions it uses
    imports: tuple[ast.Import | ast.ImportFrom, ...]  # imports of other packages and of the standard library


def bundle(arm: str, model: str) -> dict[str, object]:
    """Return the variables of the template of standalone modules, with the runtime that the module needs.

    The runtime consists of the definitions that the module uses, and of all definitions that these use in turn. The
    variables are ``imports``; ``rows``, the classes of the rows of the arm's tables, which must precede the tables;
    ``runtime``, the definitions that follow the tables; ``contents``, the names of the classes and functions in
    ``runtime``.

    arm, model: source texts of the module's tables and of its class ``Model``.
    """
    runtime = load_runtime()
    used = names_in(ast.parse(f"{arm}\n{model}"))
    pending = list(used)
    while pending:
        name = pending.pop()
        if name in runtime.definitions:
            new = runtime.definitions[name].uses - used
            used |= new
            pending += new
    # The tables of the arm consist of instances of the classes in rows.py, which must be defined before the tables.
    rows, definitions, contents = [], [], []
    for name, definition in runtime.definitions.items():
        if name in used and definition.file == "rows":
            rows.append(definition)
        elif name in used:
            definitions.append(definition)
            if definition.is_block:
                contents.append(name)
    return {
        "imports": _imports(used, runtime),
        "rows": _joined(rows),
        "runtime": _joined(definitions),
        "contents": contents,
    }


def _joined(definitions: Iterable[Definition]) -> str:
    """Return the joined source text of definitions; blank lines separate classes and functions, but not constants."""
    text, previous_is_block = "", True
    for definition in definitions:
        separate = definition.is_block or previous_is_block
        text += ("\n\n\n" if separate else "\n") + definition.text
        previous_is_block = definition.is_block
    return text.strip()


@cache
def load_runtime() -> Runtime:
    """Return the source of ``spelgen.runtime``: its import statements, and its definitions in order of dependence."""
    texts = {
        path.name.removesuffix(".py"): path.read_text(encoding="utf-8")
        for path in (files("spelgen") / "runtime").iterdir()
        if path.name.endswith(".py")
    }
    # The files are sorted, because file systems list files in different orders: a module's text must be deterministic.
    trees = {name: ast.parse(texts[name]) for name in sorted(texts)}
    del trees["__init__"]
    order: TopologicalSorter[str] = TopologicalSorter()
    imports = []
    for name, tree in trees.items():
        order.add(name)
        for node in tree.body:
            module = str(node.module) if isinstance(node, ast.ImportFrom) else ""
            if module.startswith(_OURS):
                order.add(name, module.removeprefix(_OURS))
            elif isinstance(node, ast.Import | ast.ImportFrom) and module != "__future__":
                imports.append(node)
    definitions = {}
    for name in order.static_order():
        for statement in trees[name].body:
            if (defined := _defined(statement)) is not None:
                text, is_block = _text(statement, texts[name]), not isinstance(statement, ast.Assign)
                definitions[defined] = Definition(text, frozenset(names_in(statement)), is_block, name)
    return Runtime(definitions, tuple(imports))


def _defined(node: ast.stmt) -> str | None:
    """Return the name of the class, function or constant that a statement defines; None for other statements."""
    if isinstance(node, ast.ClassDef | ast.FunctionDef):
        return node.name
    if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
        return node.targets[0].id
    return None


def _text(node: ast.stmt, source: str) -> str:
    """Return the source text of a definition, with the comment above it; decorators are not supported."""
    lines = source.splitlines()
    first = node.lineno - 1
    while first and lines[first - 1].startswith("#"):
        first -= 1
    return "\n".join(lines[first : node.end_lineno])


def _imports(used: set[str], runtime: Runtime) -> str:
    """Return import statements for the names in ``used``: standard library, then torch, each in ruff's order."""
    plain = set()
    members: defaultdict[str, set[str]] = defaultdict(set)
    for node in runtime.imports:
        aliases = [alias for alias in node.names if (alias.asname or alias.name) in used]
        texts = set(map(ast.unparse, aliases))
        if isinstance(node, ast.ImportFrom):
            members[f"from {node.module}"] |= texts
        else:
            plain |= texts
    statements = [f"import {text}" for text in sorted(plain)]
    statements += [f"{start} import {', '.join(sorted(x))}" for start, x in sorted(members.items()) if x]
    groups = [[text for text in statements if ("torch" in text) == is_torch] for is_torch in (False, True)]
    return "\n\n".join("\n".join(group) for group in groups if group)
