"""Export with ``--to c``: a C99 header and source, compiled and compared with the model if there is a compiler."""

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from spelgen.errors import RunError
from spelgen.exporting.c_estimator import CALLED, estimator_c_functions, estimator_texts
from spelgen.exporting.c_source import FRICTION_STATES, CFunction, c_functions, write_c
from spelgen.exporting.describe import Trained
from spelgen.exporting.exported import Exported, with_readme
from spelgen.exporting.parity import ENTRY_POINTS, Called, Values, check_parity
from spelgen.exporting.tuning import TUNING

# Compiler warnings are errors, because users compile the files with the strict flags of their own projects.
_FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-fPIC", "-shared")


def export_c(trained: Trained) -> Exported:
    """Return the C files of a trained model with a README, checked against the model.

    Raises RunError if results of the C code and of the model differ.
    """
    files, checked = c_files(trained)
    name = trained.described.name
    use = (
        f"Add {name}.h and {name}.c to a program and link libm (cc -std=c99 -O2 -c {name}.c); "
        "nothing is allocated or kept, so every function may be called from any thread."
    )
    about = f"matrices row by row; z is the friction state, which {name}_friction_step updates."
    return with_readme(trained, "c", files, use=use, about=about, summary=[checked])


def c_files(trained: Trained) -> tuple[dict[str, bytes], str]:
    """Return {file name: content} of the C files of a model, and a sentence with the result of the parity check.

    Raises RunError if results of the C code and of the model differ.
    """
    model, levels = trained.described, trained.levels
    entries, texts = dict(trained.entry_points), {}
    if levels is not None:
        entries |= {name: ENTRY_POINTS[name] for name in CALLED}
    functions = c_functions(model, entries)
    if levels is not None:
        functions += estimator_c_functions(model, levels)
        texts = estimator_texts(model, levels)
    # The parity check compiles exactly the bytes that the user gets.
    with tempfile.TemporaryDirectory() as folder:
        write_c(model, functions, Path(folder))
        for name, text in texts.items():
            Path(folder, name).write_text(text)
        files = {path.name: path.read_bytes() for path in sorted(Path(folder).iterdir())}
        program = compiler()
        if program is None:
            return files, "Not checked: there is no C compiler"
        called = called_by_c(compile_library(sorted(Path(folder).glob("*.c")), program), functions)
        parity = check_parity(called, trained, list(trained.entry_points), TUNING.tolerance)
    return files, f"Checked when exported, compiled by {Path(program).name}: {parity.summary}"


def compiler() -> str | None:
    """Return the path of the first C compiler on this machine among gcc, clang and cc; None if there is none."""
    return next(filter(None, map(shutil.which, ("gcc", "clang", "cc"))), None)


def compile_library(sources: Path | Sequence[Path], program: str, *flags: str) -> Path:
    """Compile C files to a shared library and return its path. Raises RunError with the compiler's messages.

    program: path of the C compiler. flags: further options of the compiler.
    """
    sources = [sources] if isinstance(sources, Path) else sources
    library = sources[0].with_suffix(".so")
    command = [program, *_FLAGS, *flags, *map(str, sources), "-o", str(library), "-lm"]
    # The compiler is run without a shell, so that special characters in the folder's name cannot be executed.
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        raise RunError(f"{Path(program).name} refuses the exported C", do=result.stderr.strip()[:500])
    return library


def called_by_c(
    library: Path, functions: Sequence[CFunction], dtype: type[np.floating] = np.float64
) -> Called:
    """Return a function for `check_parity`. It evaluates a compiled function, such as inverse_dynamics, per state.

    library: shared library of the export. functions: C functions in the library. dtype: type ``real`` of the C code.
    """
    loaded = ctypes.CDLL(str(library))
    by_name = {function.entry.name: function for function in functions}
    # The friction state z is double even if all other arrays are float: in float, the sum z + dq would lose small
    # displacements dq.
    dtypes = dict.fromkeys(FRICTION_STATES, np.float64)

    def called(name: str, inputs: Values) -> Values:
        function = by_name[name]
        call = loaded[function.symbol]
        call.restype = None
        states = len(inputs["q"])
        arguments = []
        for key in function.entry.inputs:
            arguments.append(np.ascontiguousarray(inputs[key], dtype=dtypes.get(key, dtype)))
        outputs = {}
        for key, shape in function.shapes.items():
            # Outputs start as NaN, so that the parity check fails if a function does not write an entry.
            outputs[key] = np.full((states, *shape), np.nan, dtypes.get(key, dtype))
        arguments += outputs.values()
        # The exported C functions have no batch dimension, so each is called once per state.
        for state in range(states):
            rows = [array[state : state + 1] for array in arguments]
            call(*(row.ctypes.data_as(ctypes.c_void_p) for row in rows))
        return {key: value.astype(np.float64) for key, value in outputs.items()}

    return called
