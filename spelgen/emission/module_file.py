"""The specification in the file of a module. Nothing of the file is executed."""

from __future__ import annotations

import ast
from pathlib import Path

from spelgen.emission.text import module_text
from spelgen.errors import ModuleError
from spelgen.files import read_bytes
from spelgen.spec import ModelSpec, spec_from_json

# Largest module that is read [bytes]: the largest that `spelgen build` writes has a tenth.
MAX_MODULE = 2**22
_EXPECTED = "a module written by this version of `spelgen build`"


def read_source(path: Path) -> str:
    """Return the text of the module at ``path``. Raises ModuleError."""
    if not path.exists():
        raise ModuleError("no such file", file=path, do="build it with `spelgen build`")
    content = read_bytes(path, ModuleError, _EXPECTED, MAX_MODULE)
    try:
        return content.decode("utf-8").replace("\r\n", "\n")
    except ValueError as problem:
        raise _no_module(problem, path) from None


def read_spec(path: Path | str) -> ModelSpec:
    """Return the specification in the module at ``path``. Raises ModuleError."""
    return parse_spec(read_source(Path(path)), Path(path))


def parse_spec(text: str, file: Path | None = None) -> ModelSpec:
    """Return the specification in the text of a module, which may be edited. Raises ModuleError."""
    try:
        for node in ast.parse(text).body:
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant):
                names = [target.id for target in node.targets if isinstance(target, ast.Name)]
                if names == ["FACTS"]:
                    raise ModuleError(
                        "a module of an earlier version of spelgen", file=file, expected=_EXPECTED,
                        do="build it again with `spelgen build`, and train it again",
                    )  # fmt: skip
                if names == ["SPEC"]:
                    return spec_from_json(str(node.value.value), file)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as problem:
        raise _no_module(problem, file) from None
    raise _no_module(None, file)


def require_unedited(text: str, file: Path | None = None) -> ModelSpec:
    """Return the specification in the text of a module. Raises ModuleError if the text differs from its module."""
    spec = parse_spec(text, file)
    if text in (module_text(spec, standalone=is_standalone) for is_standalone in (False, True)):
        return spec
    raise ModuleError(
        "a module that was edited, or written by another version of spelgen", file=file, expected=_EXPECTED,
        do="build it again, or use the edited one from Python: `from MODULE import Model; spelgen.fit(Model(), logs)`",
    )  # fmt: skip


def _no_module(problem: Exception | None, file: Path | None) -> ModuleError:
    reason = f" ({type(problem).__name__})" if problem is not None else ""
    return ModuleError(
        f"no specification of spelgen in it{reason}",
        file=file,
        expected=_EXPECTED,
        do="build it again, or check the path",
    )
