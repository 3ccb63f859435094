"""Find the log files that paths name."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from spelgen.errors import LogError, SpelgenError
from spelgen.files import local, require_regular_file
from spelgen.logs.formats import describe_formats, format_of


def log_files(
    paths: Path | str | Iterable[Path | str], role: str | None, errors: list[SpelgenError]
) -> list[Path]:
    """Return the logs that these paths name, each once; what cannot be one is added to the errors.

    role: "train" or "test": of a folder that holds train.* or test.* files, only those with this stem.
    """
    files: dict[Path, None] = {}
    if isinstance(paths, str | Path):
        paths = [paths]
    for name in paths:
        path = local(name)
        try:
            if not path.exists():
                raise LogError("no such file or folder", file=name, expected="a log", do="check the path")
            files |= dict.fromkeys(_logs_at(path, role))
        except LogError as error:
            errors.append(error)
    return list(files)


def _logs_at(path: Path, role: str | None) -> list[Path]:
    if format_of(path) is not None:
        return [path]
    if path.is_dir():
        return _folder_logs(path, role)
    require_regular_file(path, LogError, f"a file: {describe_formats()}")
    raise LogError(f"a file of kind {path.suffix!r}", file=path, expected=describe_formats())


def _folder_logs(folder: Path, role: str | None) -> list[Path]:
    # hidden files are not recordings: macOS puts "._log.csv" beside log.csv on other file systems
    visible = (path for path in folder.iterdir() if not path.name.startswith("."))
    logs = sorted(path for path in visible if format_of(path) is not None)
    if not logs:
        raise LogError("a folder without logs", file=folder, expected=describe_formats())
    has_roles = any(path.stem in ("train", "test") for path in logs)
    if role is None or not has_roles:
        return logs
    selected = [path for path in logs if path.stem == role]
    if not selected:
        raise LogError(
            f"a folder without {role}.* among its logs", file=folder, expected=f"{role}.*, or files by name"
        )
    return selected
