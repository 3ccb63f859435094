"""Exported C, compiled here: called by ctypes for the parity check, its code and stack measured for its header."""

from __future__ import annotations

import ctypes
import platform
import re
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from spelgen.errors import RunError
from spelgen.exporting.c_source import CEntry, c_header, c_source
from spelgen.exporting.description import TrainedModel
from spelgen.exporting.entry_points import entry_points
from spelgen.exporting.parity import Values

_FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror")


def compiler() -> str | None:
    """Return the C compiler of this machine, gcc before others; None without one."""
    # gcc first: it measures the stack as well
    for name in ("gcc", "clang", "cc"):
        program = shutil.which(name)
        if program:
            return program
    return None


def write_c(model: TrainedModel, entries: Sequence[CEntry], folder: Path) -> Path:
    """Write header and source into a folder and return the source's path."""
    source = folder / f"{model.name}.c"
    source.write_text(c_source(model, entries))
    source.with_suffix(".h").write_text(c_header(model, entries, ""))
    return source


def compile_object(source: Path, program: str, *flags: str) -> Path:
    """Compile a C file to an object beside it. Raises RunError with the messages of the compiler."""
    target = source.with_suffix(".o")
    # -fPIC for ctypes, -fstack-usage for the header
    command = [program, *_FLAGS, *flags, "-fPIC", "-fstack-usage", "-c", str(source), "-o", str(target)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        raise RunError(f"{Path(program).name} refuses the exported C", do=result.stderr.strip()[:500])
    return target


def link_library(object_file: Path, program: str) -> Path:
    """Link an object file to a shared library beside it."""
    library = object_file.with_suffix(".so")
    subprocess.run([program, "-shared", str(object_file), "-o", str(library), "-lm"], check=True)
    return library


def measured(object_file: Path, program: str, model: TrainedModel) -> str:
    """Return a sentence on the code and the stack of an object file."""
    frames = {}
    usage = object_file.with_suffix(".su")
    if usage.exists():
        for line in usage.read_text().splitlines():
            function, size, _ = line.split("\t")
            frames[function.rsplit(":", 1)[-1]] = int(size)
    stack = "stack not known"
    public = [frames.pop(f"{model.name}_{name}", 0) for name in entry_points(model)]
    if any(public):
        # an upper bound: as if each of the inner functions called the next
        inner = sum(frames.values())
        stack = f"at most {max(public) + inner} bytes of stack"
    version = subprocess.run([program, "-dumpfullversion"], capture_output=True, text=True, check=False)
    which = f"{Path(program).name} {version.stdout.strip()} -O2 on {platform.machine()}"
    return f"Compiled by {which}: {_code_size(object_file)} bytes of code and constants, {stack}"


def _code_size(object_file: Path) -> int:
    """Return the bytes of code and constants, of all of the object file where there is no program ``size``."""
    if shutil.which("size"):
        result = subprocess.run(["size", str(object_file)], capture_output=True, text=True, check=False)
        sizes = re.search(r"^\s*(\d+)\s+(\d+)", result.stdout, re.MULTILINE)
        if sizes:
            return int(sizes[1]) + int(sizes[2])
    return object_file.stat().st_size


class CLibrary:
    """The functions of a compiled export, for arrays of states."""

    def __init__(self, library: Path, model: TrainedModel, dtype: type = np.float64) -> None:
        self._library = ctypes.CDLL(str(library))
        self._model = model
        self._dtype = dtype

    def __call__(self, name: str, inputs: Values) -> Mapping[str, np.ndarray]:
        """Return an entry point's outputs, (states, ...), as float64."""
        entry = entry_points(self._model)[name]
        states = len(inputs["q"])
        function = getattr(self._library, f"{self._model.name}_{name}")
        # all results are written to arrays
        function.restype = None
        arrays: list[np.ndarray] = []
        for key in entry.inputs:
            arrays.append(np.ascontiguousarray(inputs[key], dtype=self._kind(key)))
        outputs: dict[str, np.ndarray] = {}
        for key in entry.output_names:
            # NaN: what the function does not write is noticed
            shape = (states, *self._shape(name, key))
            outputs[key] = np.full(shape, np.nan, self._kind(key))
        arrays += outputs.values()
        for state in range(states):
            rows = [array[state : state + 1] for array in arrays]
            function(*(row.ctypes.data_as(ctypes.c_void_p) for row in rows))
        return {key: value.astype(np.float64) for key, value in outputs.items()}

    def _kind(self, name: str) -> type:
        """Return the type of an input or output: friction's memory is double in any case."""
        return np.float64 if name in ("z", "z_next", "z_start") else self._dtype

    def _shape(self, entry: str, output: str) -> tuple[int, ...]:
        n, memory = self._model.n, self._model.memory
        if output in ("z_next", "z_start"):
            return (memory,)
        if entry == "mass_matrix" or entry.endswith("_derivatives"):
            return (n, n)
        return {"energy": (2,), "pose": (4, 4), "jacobian": (6, n)}.get(output, (n,))
