"""Writing results so that a file is either complete or not there."""

from __future__ import annotations

import os
from pathlib import Path


def write_text(path: Path | str, text: str) -> Path:
    """Write `text` to `path` as UTF-8, all or nothing, making its folder; return the path.

    The text goes to a hidden neighbour first, which then takes the file's place: an interrupted or failed
    write leaves what was there before. Raises OSError when the place cannot be written.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        unfinished.write_text(text, encoding="utf-8", newline="\n")
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)
    return path
