"""Expansion of xacro files by the package xacro.

A xacro file is a program: it contains Python expressions, reads other files and the environment, and is not sandboxed.
It is therefore executed only if the name of the file is ``*.xacro``, never because of the content of a file. It runs in
a separate process with limited time and memory, but with the permissions of the user.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from spelgen.errors import UrdfError
from spelgen.urdf import xacro_child

SUFFIX = ".xacro"
MAX_SECONDS = 8
MAX_MESSAGE = 400  # characters of xacro's message in an error
_BY_HAND = "expand it where that works: xacro FILE name:=value ... > ROBOT.urdf"


@dataclass(frozen=True)
class XacroOutput:
    """The expanded URDF, and the warnings of xacro."""

    data: bytes
    warnings: tuple[str, ...]


def is_xacro(path: Path) -> bool:
    """Whether the name of a file marks it as a xacro file."""
    return path.suffix.lower() == SUFFIX


def expand(path: Path, max_bytes: int) -> XacroOutput:
    """Execute a xacro file with the default values of its arguments.

    Raises UrdfError if the package xacro is not installed or fails, runs for more than 8 s, or writes more than
    ``max_bytes``.
    """
    # -P: modules in the current folder must not shadow the package
    command = [sys.executable, "-P", "-X", "utf8", xacro_child.__file__, str(path)]
    # A file and not a pipe: output of any size must not fill the memory of this process.
    with tempfile.TemporaryFile() as output:
        try:
            run = subprocess.run(
                command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.PIPE,
                timeout=MAX_SECONDS,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise UrdfError(f"xacro still running after {MAX_SECONDS} s", file=path, do=_BY_HAND) from None
        lines = run.stderr.decode(errors="replace").splitlines()
        warnings = tuple(line.removeprefix("warning: ") for line in lines if line.startswith("warning: "))
        if run.returncode:
            raise _failure(path, run.returncode, [line for line in lines if not line.startswith("warning: ")])
        size = output.seek(0, 2)
        if size > max_bytes:
            raise UrdfError(f"{size} bytes of URDF from xacro", file=path, expected=f"at most {max_bytes}")
        output.seek(0)
        return XacroOutput(output.read(), warnings)


def _failure(path: Path, code: int, lines: list[str]) -> UrdfError:
    if code == xacro_child.MISSING:
        return UrdfError(
            "a xacro file, and no package to expand it",
            file=path,
            do=f"pip install 'spelgen[xacro]', or {_BY_HAND}",
        )
    reason = " ".join(" ".join(lines).split())[:MAX_MESSAGE] or f"it ended with code {code}"
    return UrdfError(f"xacro cannot expand it ({reason})", file=path, do=f"correct it, or {_BY_HAND}")
