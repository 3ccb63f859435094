"""Resources of a fit: threads, a device, a locked folder, and an orderly end after a signal."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from filelock import FileLock, Timeout

from spelgen.errors import RunError
from spelgen.files import naming

LOCK = ".lock"


def require_device(device: str) -> None:
    """Raise RunError if torch cannot use the device."""
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise RunError(
            f"a device {device!r} that torch cannot use ({reason})", do="use the device cpu"
        ) from error


@contextmanager
def threads_of_torch(count: int) -> Iterator[None]:
    """Set the number of torch's threads: more than two rarely help small matrices, and one makes runs repeatable."""
    previous = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(previous)


@contextmanager
def termination_as_interrupt() -> Iterator[None]:
    """End training after SIGTERM as after Ctrl-C. Only the main thread can set handlers; others have no effect."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(signum: int, frame: object) -> None:
        raise KeyboardInterrupt

    previous = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)


@contextmanager
def locked(folder: Path | None) -> Iterator[None]:
    """Create the folder and lock it against other processes of this machine; None: no effect.

    Raises RunError with the process that holds the lock. The kernel releases the lock when its holder ends for any
    reason, so a remaining file has no effect.
    """
    if folder is None:
        yield
        return
    created = [path for path in (folder, *folder.parents) if not path.exists()]
    file = folder / LOCK
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
            if not any(path.iterdir()):  # the fit wrote nothing
                path.rmdir()
