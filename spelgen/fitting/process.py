"""What a fit asks of the process it runs in: threads, a device, and that a signal ends it in good order."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from spelgen.errors import RunError


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
