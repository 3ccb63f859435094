"""--to c: a header and a source, compiled here and held against the model where there is a compiler."""

from __future__ import annotations

import tempfile
from pathlib import Path

from spelgen.exporting.c_code import c_entries, c_header, c_source
from spelgen.exporting.c_library import CLibrary, compile_object, compiler, link_library, measured
from spelgen.exporting.entry_points import entry_points
from spelgen.exporting.exported import Exported
from spelgen.exporting.parity import check_parity
from spelgen.exporting.readme import UNITS, readme
from spelgen.exporting.trained import Trained

TOLERANCE = 1e-12


def export_c(trained: Trained) -> Exported:
    """The C files of a trained model. Raises RunError where they do not give what the model gives."""
    files, checked = c_files(trained)
    model = trained.described
    use = (
        f"Add {model.name}.h and {model.name}.c to a program and link libm (cc -std=c99 -O2 -c {model.name}.c); "
        "nothing is allocated or kept, so every function may be called from any thread."
    )
    about = (
        f"{UNITS}; matrices row by row; z is friction's memory, {model.name}_friction_step moves it along."
    )
    title = f"Dynamics of {model.robot} in C99"
    text = readme(title, use, trained.joint_names, about, checked)
    return Exported("c", model.robot, {**files, "README.md": text}, (checked,))


def c_files(trained: Trained) -> tuple[dict[str, bytes], str]:
    """Header and source by name, and a sentence on how they were checked."""
    model, program = trained.described, compiler()
    entries = c_entries(model)
    header, source = f"{model.name}.h", c_source(model, entries)
    sizes, checked = "Sizes are not known: no C compiler was there", "Not checked: no C compiler was there."
    if program is not None:
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder, f"{model.name}.c")
            place.write_text(source)
            place.with_name(header).write_text(c_header(model, entries, ""))
            compiled = compile_object(place, program)
            sizes = measured(compiled, program)
            library = CLibrary(link_library(compiled, program), model)
            names = [entry.name for entry in entry_points(model)]
            parity = check_parity(library, trained, names, TOLERANCE, memory=model.memory)
        checked = f"Checked when exported, compiled by {Path(program).name}: {parity.summary}."
    files = {header: c_header(model, entries, sizes), f"{model.name}.c": source}
    return {name: text.encode() for name, text in files.items()}, checked
