"""--to c: a header and a source, compiled here and held against the model where there is a compiler."""

from __future__ import annotations

import tempfile
from pathlib import Path

from spelgen.exporting.c_library import CLibrary, compile_object, compiler, link_library, measured, write_c
from spelgen.exporting.c_source import c_entries, c_header
from spelgen.exporting.entry_points import entry_points
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
    model, program = trained.described, compiler()
    entries = c_entries(model)
    sizes, checked = (
        "Sizes were not measured: no C compiler was found",
        "Not checked: no C compiler was there.",
    )
    with tempfile.TemporaryDirectory() as folder:
        source = write_c(model, entries, Path(folder))
        content = source.read_bytes()
        if program is not None:
            compiled = compile_object(source, program)
            sizes = measured(compiled, program, model)
            library = CLibrary(link_library(compiled, program), model)
            parity = check_parity(library, trained, list(entry_points(model)), TUNING.tolerance)
            checked = f"Checked when exported, compiled by {Path(program).name}: {parity.summary}."
    # again, for the sizes are known after it was compiled
    header = c_header(model, entries, sizes)
    return {f"{model.name}.h": header.encode(), f"{model.name}.c": content}, checked
