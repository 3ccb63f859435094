"""One training at a time in a run folder."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from spelgen.errors import RunError
from spelgen.files import naming

NAME = ".lock"


@contextmanager
def locked(folder: Path | None) -> Iterator[None]:
    """Make the folder, and keep other processes of this machine from training in it; None: do nothing.

    Raises RunError that names who trains there already. The kernel lets go of the lock when its holder ends, however it
    ends; so the file may stay behind.
    """
    if folder is None:
        yield
        return
    created = [path for path in (folder, *folder.parents) if not path.exists()]
    file = folder / NAME
    lock = FileLock(file, timeout=0)
    with naming(folder):
        folder.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire()
        except Timeout:
            holder = file.read_text(encoding="utf-8")[:200].strip() or "another process"
            raise RunError(
                f"{holder} trains in this folder", file=folder, do="wait for it, or -o another"
            ) from None
    try:
        file.write_text(f"process {os.getpid()} on {socket.gethostname()}, since {time.strftime('%F %T')},")
        yield
    finally:
        file.unlink(missing_ok=True)
        lock.release()
        for path in created:
            if not any(path.iterdir()):  # nothing came of it
                path.rmdir()
