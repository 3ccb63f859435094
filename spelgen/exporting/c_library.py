"""Exported C, compiled here: called by ctypes for the parity check, its code and stack measured for its header."""

from __future__ import annotations

import ctypes
import platform
import re
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from spelgen.errors import RunError
from spelgen.exporting.description import TrainedModel
from spelgen.exporting.entry_points import ENTRY_POINTS, SERVO
from spelgen.exporting.parity import Values

FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror")


def compiler() -> str | None:
    """The C compiler of this machine, gcc before others; None without one."""
    return next((found for name in ("gcc", "clang", "cc") if (found := shutil.which(name))), None)


def compile_object(source: Path, program: str, *flags: str) -> Path:
    """An object file of a C file beside it, with FLAGS. Raises RunError with what the compiler says."""
    found = source.with_suffix(".o")
    command = [program, *FLAGS, *flags, "-fPIC", "-fstack-usage", "-c", str(source), "-o", str(found)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RunError(f"{Path(program).name} refuses the exported C", do=done.stderr.strip()[:500])
    return found


def link_library(object_file: Path, program: str) -> Path:
    """A shared library of an object file, beside it."""
    library = object_file.with_suffix(".so")
    subprocess.run([program, "-shared", str(object_file), "-o", str(library), "-lm"], check=True)
    return library


def measured(object_file: Path, program: str) -> str:
    """A sentence on the code and the stack that an object file takes."""
    usage = object_file.with_suffix(".su")
    frames = [line.split("\t") for line in usage.read_text().splitlines()] if usage.exists() else []
    own = {name.rsplit(":", 1)[-1]: int(size) for name, size, _ in frames}
    public = [own[name] for name in own if any(name.endswith(entry.name) for entry in (*ENTRY_POINTS, SERVO))]
    inner = sum(own.values()) - sum(public)  # at most: as if each called the next
    version = subprocess.run([program, "-dumpfullversion"], capture_output=True, text=True, check=False)
    which = f"{Path(program).name} {version.stdout.strip()} -O2 on {platform.machine()}"
    stack = f"at most {max(public) + inner} bytes of stack" if public else "stack not known"
    return f"By {which}: {_code_size(object_file)} bytes of code and constants, {stack}"


def _code_size(object_file: Path) -> int:
    """Code and constants of an object file, in bytes."""
    if shutil.which("size") is None:
        return object_file.stat().st_size
    told = subprocess.run(["size", str(object_file)], capture_output=True, text=True, check=False).stdout
    found = re.search(r"^\s*(\d+)\s+(\d+)", told, re.MULTILINE)
    return int(found[1]) + int(found[2]) if found else object_file.stat().st_size


class CLibrary:
    """The functions of a compiled export, for arrays of states."""

    def __init__(self, library: Path, model: TrainedModel, dtype: Any = np.float64) -> None:
        self._library, self._model, self._dtype = ctypes.CDLL(str(library)), model, dtype
        self._entries = {entry.name: entry for entry in (*ENTRY_POINTS, SERVO)}

    def __call__(self, name: str, inputs: Values) -> Mapping[str, np.ndarray]:
        """An entry point's outputs, (states, ...), as float64."""
        entry, n, count = self._entries[name], self._model.n, len(inputs["q"])
        function = getattr(self._library, f"{self._model.name}_{name}")
        function.restype = None
        given = [np.ascontiguousarray(inputs[key], dtype=self._dtype) for key in entry.inputs]
        shapes = {key: _shape(name, key, n, self._model.memory) for key, _ in entry.outputs}
        found = {key: np.full((count, *shape), np.nan, self._dtype) for key, shape in shapes.items()}
        for state in range(count):
            rows = [*(each[state] for each in given), *(each[state] for each in found.values())]
            function(*(row.ctypes.data_as(ctypes.c_void_p) for row in rows))
        return {key: value.astype(np.float64) for key, value in found.items()}


def _shape(entry: str, output: str, n: int, memory: int) -> tuple[int, ...]:
    if entry in ("mass_matrix", "inverse_dynamics_derivatives", "forward_dynamics_derivatives"):
        return n, n
    return {
        "pose": (4, 4),
        "jacobian": (6, n),
        "energy": (2,),
        "z_next": (memory,),
        "z_start": (memory,),
    }.get(output, (n,))
