"""Exported C, compiled here and called by ctypes for the parity check."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from spelgen.errors import RunError
from spelgen.exporting.c_source import MEMORIES, CFunction
from spelgen.exporting.parity import Called, Values

_FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-fPIC", "-shared")


def compiler() -> str | None:
    """Return the C compiler of this machine; None without one."""
    for name in ("gcc", "clang", "cc"):
        program = shutil.which(name)
        if program:
            return program
    return None


def compile_library(source: Path, program: str, *flags: str) -> Path:
    """Compile a C file to a shared library beside it. Raises RunError with the messages of the compiler."""
    library = source.with_suffix(".so")
    command = [program, *_FLAGS, *flags, str(source), "-o", str(library), "-lm"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        raise RunError(f"{Path(program).name} refuses the exported C", do=result.stderr.strip()[:500])
    return library


def called_by_c(
    library: Path, functions: Sequence[CFunction], dtype: type[np.floating] = np.float64
) -> Called:
    """Return what calls the functions of a compiled export, for arrays of states; outputs are float64."""
    loaded = ctypes.CDLL(str(library))
    by_name = {function.entry.name: function for function in functions}

    def kind(name: str) -> type[np.floating]:
        # friction's memory is double in any case
        return np.float64 if name in MEMORIES else dtype

    def called(name: str, inputs: Values) -> Values:
        function = by_name[name]
        call = getattr(loaded, function.symbol)
        # all results are written to arrays
        call.restype = None
        states = len(inputs["q"])
        arguments = [np.ascontiguousarray(inputs[key], dtype=kind(key)) for key in function.entry.inputs]
        outputs: Values = {}
        for key, shape in function.shapes.items():
            # NaN: what the function does not write is noticed
            outputs[key] = np.full((states, *shape), np.nan, kind(key))
        arguments += outputs.values()
        for state in range(states):
            rows = [array[state : state + 1] for array in arguments]
            call(*(row.ctypes.data_as(ctypes.c_void_p) for row in rows))
        return {key: value.astype(np.float64) for key, value in outputs.items()}

    return called
