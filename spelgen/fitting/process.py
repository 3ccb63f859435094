"""Resources of a fit: threads, device, locked folder, end after a signal, and progress on the terminal."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

import torch
from filelock import FileLock, Timeout
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

from spelgen.errors import Diagnostic, RunError
from spelgen.files import naming
from spelgen.fitting.run_record import Content
from spelgen.labels import counted

LOCK = ".lock"


def require_device(device: str) -> None:
    """Raise RunError if torch cannot use the device."""
    try:
        # torch has no test for a device: it raises an error at the first tensor.
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise RunError(
            f"a device {device!r} that torch cannot use ({reason})", do="use the device cpu"
        ) from error


@contextmanager
def threads_of_torch(count: int) -> Iterator[None]:
    """Set the number of torch's threads to ``count`` within a context.

    More than two threads rarely accelerate operations on small matrices; with one thread, runs are repeatable.
    """
    previous = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(previous)


@contextmanager
def termination_as_interrupt() -> Iterator[None]:
    """Raise KeyboardInterrupt at SIGTERM, as at Ctrl-C, within a context.

    Only the main thread can set signal handlers; in other threads the context has no effect.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    previous = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)


@contextmanager
def locked(folder: Path | None) -> Iterator[None]:
    """Create the folder and, within a context, lock it against other processes of this machine.

    folder: None if there is nothing to lock. Raises RunError if another process has locked the folder; the message
    names the process. The kernel releases the lock when this process ends for any reason, so a remaining lock file has
    no effect.
    """
    if folder is None:
        yield
        return
    # `created` are the folders that are created here, and removed again if the fit writes nothing into them.
    created = [path for path in (folder, *folder.parents) if not path.exists()]
    file = folder / LOCK
    # An error is raised at once, without waiting for the lock: the user may not know of the other process.
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
        # Another process that finds the lock shows the text of this file in its error message.
        file.write_text(f"process {os.getpid()} on {socket.gethostname()}, since {time.strftime('%F %T')},")
        yield
    finally:
        file.unlink(missing_ok=True)
        lock.release()
        for path in created:
            # A new folder that is still empty is removed: the fit wrote nothing into it.
            if not any(path.iterdir()):
                path.rmdir()


class TrainingProgress:
    """Context that shows the progress of a fit on stderr: a bar on a terminal, otherwise one line per stage.

    show: if False, nothing is printed.
    """

    def __init__(self, *, show: bool) -> None:
        self._show = show
        self._console = Console(stderr=True, highlight=False, soft_wrap=True)
        columns = ("{task.description}", BarColumn(12), MofNCompleteColumn(), TimeRemainingColumn())
        self._bar = Progress(*columns, "{task.fields[state]}", console=self._console)
        self._task = self._bar.add_task("training", total=None, visible=False, state="")
        # text about the progress of the current stage, printed at the end of the stage if there is no terminal
        self._line = ""

    def __enter__(self) -> TrainingProgress:
        if self._show and self._console.is_terminal:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # A progress bar that was not started is not stopped either: rich would print an empty line.
        if self._bar.live.is_started:
            self._bar.stop()
        self._end_stage()

    def note(self, diagnostic: Diagnostic) -> None:
        """Print a diagnostic above the progress bar."""
        if self._show:
            text = str(diagnostic)
            self._console.print("".join(c if c.isprintable() else "?" for c in text), markup=False)

    def momentum(self, step: int, steps: int, loss: float) -> None:
        """Show the progress of minimizing `momentum_loss`: number of steps, their maximum, and loss."""
        state = f"loss {loss:.3g}"
        self._show_stage("momentum", step, steps, state, f"{step} steps, {state}")

    def round(self, number: int, rounds: int, steps: int, rms: float) -> None:
        """Show the progress of a servo fit: outer iteration ``number`` of ``rounds``, and number of solver steps.

        rms: RMS position error [rad, m].
        """
        state = f"{steps} steps, errors {1000 * rms:.3g} mrad"
        self._show_stage("servos", number, rounds, state, state)

    def epoch(self, record: Content, epochs: int) -> None:
        """Show the progress after an epoch. record: its line of metrics.jsonl; epochs: maximum number of epochs."""
        state = f"validation {record['validation']:.3g}, best {record['best']:.3g}"
        rate, epochs_done = record["step"] / record["seconds"], counted(record["epoch"], "epoch")
        line = f"{epochs_done}, loss {record['loss']:.3g}, {state}, {rate:.1f} steps/s"
        self._show_stage("training", record["epoch"], epochs, state, line)

    def _show_stage(self, stage: str, done: int, total: int, state: str, line: str) -> None:
        """Show in the bar that ``done`` of ``total`` steps of a stage are complete, and the text ``state``.

        Without a terminal, ``line`` is printed when the stage ends.
        """
        if not self._line.startswith(stage):
            self._end_stage()
            self._bar.reset(self._task, description=stage, total=total, visible=True)
        self._bar.update(self._task, completed=done, state=state)
        self._line = f"{stage}: {line}"

    def _end_stage(self) -> None:
        if self._line and self._show and not self._console.is_terminal:
            self._console.print(self._line, markup=False)
        self._line = ""
