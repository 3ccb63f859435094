"""Writing results so that a file is either complete or not there."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from spelgen.addresses import sent


@contextmanager
def replacing(path: Path | str) -> Iterator[Path]:
    """A hidden neighbour to write to, which in the end takes the place of `path`, also through a power cut.

    Makes the folder, and sends the file to its address if it has one. An interrupted or failed write leaves what was
    there before. Raises OSError naming the path when it cannot be written: a full disk, say.
    """
    path = Path(path)
    with naming(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        try:
            yield unfinished
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
    """Within it, an OSError that names no file (of a full disk) names this one."""
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


def write_json(path: Path | str, content: dict[str, Any]) -> Path:
    """Write indented JSON, all or nothing; return the path."""
    return write_text(path, json.dumps(content, indent=2) + "\n")
