"""What the package xacro makes of a xacro file.

A xacro file is a program: it holds Python expressions, reads other files and the environment, and nothing
contains it. So it is run only where its user says so by its name, ``*.xacro``, and never because of what a
file holds. It gets a process of its own, which bounds its time and memory, not what it may do.
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
_BY_HAND = "expand it where that works: xacro FILE name:=value ... > ROBOT.urdf"
_TOLD_AT_MOST = 400


@dataclass(frozen=True)
class Expansion:
    """The plain URDF, and what xacro warned of."""

    data: bytes
    warnings: tuple[str, ...]


def is_xacro(path: Path) -> bool:
    """Whether a file is, by its name, to be run as a xacro file."""
    return path.suffix.lower() == SUFFIX


def expand(path: Path, max_bytes: int) -> Expansion:
    """Run a xacro file, with the default values of its arguments.

    Raises ``UrdfError`` where the package xacro is not installed or fails, runs for more than 8 s, or
    writes more than ``max_bytes``.
    """
    # -P: the folder in which spelgen is called must not stand in for the package
    command = [sys.executable, "-P", "-X", "utf8", xacro_child.__file__, str(path)]
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
        return Expansion(output.read(), warnings)


def _failure(path: Path, code: int, lines: list[str]) -> UrdfError:
    if code == xacro_child.MISSING:
        return UrdfError(
            "a xacro file, and no package to expand it",
            file=path,
            do=f"pip install 'spelgen[xacro]', or {_BY_HAND}",
        )
    told = " ".join(" ".join(lines).split())[:_TOLD_AT_MOST] or f"it ended with code {code}"
    return UrdfError(f"xacro cannot expand it ({told})", file=path, do=f"correct it, or {_BY_HAND}")
