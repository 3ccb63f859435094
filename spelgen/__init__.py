"""spelgen generates a PyTorch model of a robot arm's dynamics, with the exact structure of the arm, from a URDF."""

import ast
from importlib import import_module
from pathlib import Path

# {name of the API: module that defines it}. The names are read from the stub file `__init__.pyi`: type checkers read
# this file, too, so that the API is listed only once. A module is imported at the first use of a name (PEP 562), so
# that `import spelgen` is fast.
_HOME = {
    alias.name: str(node.module)
    for node in ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body
    if isinstance(node, ast.ImportFrom)
    for alias in node.names
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> object:
    if name in _HOME:
        return vars(import_module(_HOME[name]))[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
