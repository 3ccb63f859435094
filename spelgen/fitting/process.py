"""What a fit asks of the machine: threads, a device, a folder of its own, and that a signal ends it in good order."""

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
    """Raise RunError where torch cannot use it."""
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise RunError(
            f"a device {device!r} that torch cannot use ({reason})", do="use the device cpu"
        ) from error


@contextmanager
def threads_of_torch(count: int) -> Iterator[None]:
    """The matrices are tiny: more than two threads rarely help, and one makes runs repeatable."""
    previous = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(previous)


@contextmanager
def termination_as_interrupt() -> Iterator[None]:
    """SIGTERM ends training as Ctrl-C does. Only the main thread may set handlers; others change nothing."""
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
    """Make the folder, and keep other processes of this machine from training in it; None: do nothing.

    Raises RunError that names who trains there already. The kernel lets go of the lock when its holder ends, however it
    ends; so the file may stay behind.
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
            if not any(path.iterdir()):  # nothing came of it
                path.rmdir()
