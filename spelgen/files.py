"""Read regular files alone, and write files so that each is either complete or not there."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from spelgen.addresses import sent
from spelgen.errors import SpelgenError


def require_regular_file(path: Path, error: type[SpelgenError], expected: str | None = None) -> None:
    """Raise ``error`` unless a path is a regular file: whoever opens a pipe or a device may wait for ever."""
    if not path.is_file():
        raise error("no regular file", file=path, expected=expected)


@contextmanager
def replacing(path: Path | str) -> Iterator[Path]:
    """Yield a hidden neighbour to write to, which in the end takes the place of `path`, also through a power cut.

    Makes the folder, and sends the file to its address if it has one. An interrupted or failed write leaves what was
    there before. Raises OSError naming the path when it cannot be written: a full disk, say.
    """
    path = Path(path)
    with naming(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        try:
            yield unfinished
            # without it the new name may stand before the new content does, when power is cut
            with unfinished.open("rb+") as file:
                os.fsync(file.fileno())
            os.replace(unfinished, path)
            sent(path)
        finally:
            unfinished.unlink(missing_ok=True)


def remove(path: Path) -> None:
    """Remove a file, at its address too; nothing where there is none."""
    path.unlink(missing_ok=True)
    sent(path)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Name this file in an OSError that names none, as that of a full disk."""
    try:
        yield
    except OSError as error:
        if error.filename is not None:
            raise
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error


def write_bytes(path: Path | str, content: bytes) -> Path:
    """Write `content` to `path`, all or nothing (see `replacing`); return the path."""
    with replacing(path) as unfinished:
        unfinished.write_bytes(content)
    return Path(path)


def write_text(path: Path | str, text: str) -> Path:
    """Write `text` to `path` as UTF-8, all or nothing; return the path."""
    return write_bytes(path, text.encode())


def write_json(path: Path | str, content: Mapping[str, object]) -> Path:
    """Write indented JSON, all or nothing; return the path."""
    return write_text(path, json.dumps(content, indent=2) + "\n")
