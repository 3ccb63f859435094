"""What a person sees while a model trains: a bar with loss, speed and time left, or a line now and then."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from spelgen.errors import Diagnostic

LINE_EVERY = 10.0  # [s] between lines where no bar can be drawn


class TrainingProgress:
    """A context that shows epochs as they end, on stderr; nothing at all when `show` is False."""

    def __init__(self, epochs: int, *, show: bool) -> None:
        self._epochs = epochs
        self._show = show
        self._console = Console(stderr=True, highlight=False, soft_wrap=True)
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        self._bar = Progress(*columns, TextColumn("{task.fields[state]}"), console=self._console)
        self._task = self._bar.add_task("training", total=epochs, state="")
        self._last_line = -LINE_EVERY

    def __enter__(self) -> TrainingProgress:
        if self._show and self._console.is_terminal:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar.live.is_started:  # else rich would print an empty line
            self._bar.stop()

    def note(self, diagnostic: Diagnostic) -> None:
        """Tell a diagnostic above the bar."""
        if self._show:
            text = f"{diagnostic.severity}: {diagnostic.where}: {diagnostic.message}"
            self._console.print("".join(c if c.isprintable() else "?" for c in text), markup=False)

    def momentum(self, step: int, steps: int, loss: float) -> None:
        """Show how far the momentum steps are."""
        if not self._show or step % 100:
            return
        state = f"momentum {step}/{steps}, loss {loss:.3g}"
        self._bar.update(self._task, state=escape(state))
        if not self._console.is_terminal and (step == steps or step % 1000 == 0):
            self._console.print(state, markup=False)

    def epoch(self, record: dict[str, Any]) -> None:
        """Show one line of metrics.jsonl."""
        if not self._show:
            return
        state = (
            f"loss {record['loss']:.3g}, validation {record['validation']:.3g} (best {record['best']:.3g}), "
            f"{record['step'] / record['seconds']:.1f} steps/s"
        )
        self._bar.update(self._task, completed=record["epoch"], state=escape(state))
        now = time.monotonic()
        if not self._console.is_terminal and now - self._last_line >= LINE_EVERY:
            self._last_line = now
            self._console.print(f"epoch {record['epoch']}/{self._epochs}: {state}", markup=False)
