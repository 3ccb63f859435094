"""Paths -> the log files that they name."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from spelgen.addresses import local
from spelgen.errors import LogError, SpelgenError
from spelgen.logs.tables import SUFFIXES, is_log

KINDS = f"{', '.join(SUFFIXES)}, the folder of a ROS 2 bag or of a LeRobot data set"


def log_files(
    paths: Path | str | Iterable[Path | str], role: str | None, errors: list[SpelgenError]
) -> list[Path]:
    """The files and bags that these paths name, each once; what cannot be one is added to the errors."""
    files: dict[Path, None] = {}
    for given in [paths] if isinstance(paths, str | Path) else paths:
        path = local(given)
        if is_log(path):
            files[path] = None
        elif path.is_dir():
            found = _folder_files(path, role)
            if not found:
                several = any(map(is_log, path.iterdir()))  # that are those of another role
                got = f"a folder without {role}.* among its logs" if several else "a folder without logs"
                errors.append(
                    LogError(got, file=path, expected=f"{role}.*, or files by name" if several else KINDS)
                )
            files |= dict.fromkeys(found)
        elif not path.exists():
            errors.append(
                LogError("no such file or folder", file=given, expected="a log", do="check the path")
            )
        elif not path.is_file():
            errors.append(LogError("a pipe or a device", file=path, expected=f"a file: {KINDS}"))
        else:
            errors.append(LogError(f"a file of kind {path.suffix!r}", file=path, expected=KINDS))
    return list(files)


def _folder_files(folder: Path, role: str | None) -> list[Path]:
    found = sorted(filter(is_log, folder.iterdir()))
    if role and any(path.stem in ("train", "test") for path in found):
        return [path for path in found if path.stem == role]
    return found
