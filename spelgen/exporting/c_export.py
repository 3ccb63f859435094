"""--to c: a header and a source, compiled here and held against the model where there is a compiler."""

from __future__ import annotations

import tempfile
from pathlib import Path

from spelgen.exporting.c_library import called_by_c, compile_library, compiler
from spelgen.exporting.c_source import c_functions, write_c
from spelgen.exporting.exported import Exported, folder_export
from spelgen.exporting.parity import check_parity
from spelgen.exporting.trained import Trained
from spelgen.settings.tuning.exporting import TUNING


def export_c(trained: Trained) -> Exported:
    """Return the C files of a trained model. Raises RunError where they differ from the model."""
    files, checked = c_files(trained)
    name = trained.described.name
    use = (
        f"Add {name}.h and {name}.c to a program and link libm (cc -std=c99 -O2 -c {name}.c); "
        "nothing is allocated or kept, so every function may be called from any thread."
    )
    about = f"matrices row by row; z is friction's memory, {name}_friction_step moves it along."
    return folder_export(trained, "c", "in C99", files, use=use, about=about, checked=checked)


def c_files(trained: Trained) -> tuple[dict[str, bytes], str]:
    """Return header and source by name, and a sentence on how they were checked."""
    functions = c_functions(trained.described, trained.entry_points)
    checked = "Not checked: no C compiler was there."
    program = compiler()
    with tempfile.TemporaryDirectory() as folder:
        source = write_c(trained.described, functions, Path(folder))
        files = {path.name: path.read_bytes() for path in (source.with_suffix(".h"), source)}
        if program is not None:
            library = called_by_c(compile_library(source, program), functions)
            parity = check_parity(library, trained, list(trained.entry_points), TUNING.tolerance)
            checked = f"Checked when exported, compiled by {Path(program).name}: {parity.summary}."
    return files, checked
