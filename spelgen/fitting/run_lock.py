"""One training at a time in a run folder."""

from __future__ import annotations

import fcntl
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from spelgen.addresses import address_of
from spelgen.errors import Diagnostic, RunError
from spelgen.files import naming
from spelgen.fitting.address_lock import NAME, locked_address


@contextmanager
def locked(folder: Path | None) -> Iterator[list[Diagnostic]]:
    """Make the folder, and keep others from training in it, at its address too; RunError that names who does already.

    The kernel lets go of the lock when its holder ends, however it ends; so the file may stay behind. None: nothing.
    What there is to tell: of a lock at an address that was taken over.
    """
    if folder is None:
        yield []
        return
    new = [each for each in (folder, *folder.parents) if not each.exists()]
    with naming(folder):
        folder.mkdir(parents=True, exist_ok=True)
        lock = _taken(folder)
    with lock:
        lock.truncate(0)
        lock.write(f"process {os.getpid()} on {socket.gethostname()}, since {time.strftime('%F %T')},")
        lock.flush()
        try:
            with locked_address(address_of(folder)) as notes:
                yield notes
        finally:
            (folder / NAME).unlink(missing_ok=True)
            for each in new:
                if not any(each.iterdir()):  # nothing came of it
                    each.rmdir()


def _taken(folder: Path) -> TextIO:
    """The locked file, open; that of a holder who removed it meanwhile is no lock."""
    path = folder / NAME
    while True:
        lock = path.open("a+", encoding="utf-8")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.seek(0)
            with lock:
                holder = lock.read(200).strip() or "another process"
            raise RunError(
                f"{holder} trains in this folder", file=folder, do="wait for it, or -o another"
            ) from None
        if path.exists() and path.stat().st_ino == os.fstat(lock.fileno()).st_ino:
            return lock
        lock.close()
