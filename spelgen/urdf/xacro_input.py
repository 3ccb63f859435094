"""Expansion of xacro files by the package xacro.

A xacro file is a program: it contains Python expressions, reads other files and the environment, and is not sandboxed.
It is therefore executed only if the name of the file is ``*.xacro``, never because of the content of a file. It runs in
a separate process with limited time and memory, but with the permissions of the user. This module is also the program
of this process: it expands the file in its argument to stdout and writes messages to stderr.
"""

import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from spelgen.errors import UrdfError

MAX_SECONDS = 8
MEMORY = 2**30  # largest memory of the process that runs xacro [bytes]
MISSING = 3  # exit code of the process if it cannot import the package xacro
_BY_HAND = "expand it where that works: xacro FILE name:=value ... > ROBOT.urdf"


def expand(path: Path, max_bytes: int) -> tuple[bytes, tuple[str, ...]]:
    """Return the URDF to which a xacro file expands with the default values of its arguments, and xacro's warnings.

    Raises UrdfError if the package xacro is not installed or fails, runs for more than 8 s, or writes more than
    ``max_bytes``.
    """
    # With the option -P of Python, modules in the current folder cannot shadow the package.
    command = [sys.executable, "-P", "-X", "utf8", "-m", "spelgen.urdf.xacro_input", str(path)]
    # xacro writes to a file: a pipe would be read into the memory of this process, and the output may be very large.
    with tempfile.TemporaryFile() as output:
        try:
            run = subprocess.run(
                command, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.PIPE, timeout=MAX_SECONDS,
                check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            raise UrdfError(f"xacro still running after {MAX_SECONDS} s", file=path, do=_BY_HAND) from None
        lines = run.stderr.decode(errors="replace").splitlines()
        warnings = tuple(line.removeprefix("warning: ") for line in lines if line.startswith("warning: "))
        # If xacro fails, all lines that it has printed, except warnings, are part of the error: they often state the
        # cause of the failure.
        if run.returncode:
            raise _failure(path, run.returncode, [line for line in lines if not line.startswith("warning: ")])
        size = output.seek(0, 2)
        if size > max_bytes:
            raise UrdfError(f"{size} bytes of URDF from xacro", file=path, expected=f"at most {max_bytes}")
        output.seek(0)
        return output.read(), warnings


def _failure(path: Path, code: int, lines: list[str]) -> UrdfError:
    if code == MISSING:
        do = f"pip install 'spelgen[xacro]', or {_BY_HAND}"
        return UrdfError("a xacro file, and no package to expand it", file=path, do=do)
    # The message of xacro is cut at 400 characters, because its length is not limited.
    reason = " ".join(" ".join(lines).split())[:400] or f"it ended with code {code}"
    # Xacro states some exceptions twice, the first time with their class: one statement is removed.
    reason = re.sub(r"^<class '[\w.]+'>: (.+) \1", r"\1", reason)
    return UrdfError(f"xacro cannot expand it ({reason})", file=path, do=f"correct it, or {_BY_HAND}")


def _find_packages_above(functions: dict[str, Callable[[str], str]], path: Path) -> None:
    """Replace xacro's function for $(find PACKAGE), so that packages are found without ROS.

    A package is searched in the folders above the file ``path``, in their subfolders PACKAGE and */PACKAGE (another
    repository of the workspace), and then by xacro.
    functions: xacro's functions by name, of which ``_eval_find`` is replaced.
    """
    installed = functions["_eval_find"]

    def find(package: str) -> str:
        for folder in path.parents:
            repositories = sorted(folder.glob("*/"))
            for candidate in (folder, folder / package, *(x / package for x in repositories)):
                manifest = candidate / "package.xml"
                if manifest.is_file():
                    name = re.search(r"<name>\s*(.*?)\s*</name>", manifest.read_text(errors="replace"))
                    if name and name[1] == package:
                        return str(candidate)
        # A package without package.xml is recognised by the name of its folder.
        named = [folder for folder in path.parents if folder.name == package]
        # The search of xacro raises errors of any type if ROS is absent or does not know the package: the error below
        # replaces them.
        with suppress(Exception):
            return str(named[0]) if named else installed(package)
        raise ValueError(
            f"the package {package!r} of $(find {package}) is neither above the file nor known to ROS"
        )

    functions["_eval_find"] = find


def main(path: str) -> None:
    """Write the expanded URDF to stdout, with the line breaks of the command ``xacro FILE``."""
    with suppress(ImportError):  # On Windows there is no module `resource`, and no limit of memory.
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    try:
        import xacro
        from xacro import substitution_args
    except ModuleNotFoundError:
        sys.exit(MISSING)
    _find_packages_above(vars(substitution_args), Path(path).resolve())
    try:
        document = xacro.process_file(path)
        for comment in document.childNodes:
            # The comment of xacro at the top contains the path of the command line. It is removed, so that the bytes
            # do not depend on the path.
            if comment is not document.documentElement and " autogenerated by xacro " in comment.data:
                comment.data = ""
        text = document.toprettyxml(indent="  ")
    except Exception as error:
        print(str(error).strip() or type(error).__name__, file=sys.stderr)
        xacro.print_location()
        sys.exit(1)
    sys.stdout.buffer.write(text.encode())


if __name__ == "__main__":
    main(sys.argv[1])
