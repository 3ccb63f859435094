"""The file of a module -> its model: the function ``load_module``. Nothing of the file is executed."""

from __future__ import annotations

from pathlib import Path

from spelgen.emission.assemble import ArmModel, assemble
from spelgen.emission.module_file import read_source, require_unedited


def load_module(module: str | Path, *, seed: int = 0) -> ArmModel:
    """Return the model of a module that `spelgen build` wrote, with the initial weights of ``seed``.

    module: the file, or its text. Raises ModuleError for a file that was edited or is no such module.
    """
    is_text = isinstance(module, str) and "\n" in module
    file = None if is_text else Path(module)
    text = str(module) if file is None else read_source(file)
    return assemble(require_unedited(text, file), seed)
