"""Progress of a fit on the terminal: a bar with loss and remaining time, or one line per stage."""

from __future__ import annotations

from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from spelgen.errors import Diagnostic
from spelgen.fitting.run_record import Content
from spelgen.labels import counted


class TrainingProgress:
    """Progress on stderr within a context: a bar, or one line per stage without a terminal; nothing without `show`."""

    def __init__(self, *, show: bool) -> None:
        self._show = show
        self._console = Console(stderr=True, highlight=False, soft_wrap=True)
        columns = (
            TextColumn("{task.description}"),
            BarColumn(12),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
        )
        self._bar = Progress(*columns, TextColumn("{task.fields[state]}"), console=self._console)
        self._task = self._bar.add_task("training", total=None, visible=False, state="")
        self._line = ""  # of the current stage, printed at its end without a terminal

    def __enter__(self) -> TrainingProgress:
        if self._show and self._console.is_terminal:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar.live.is_started:  # rich prints an empty line otherwise
            self._bar.stop()
        self._end_stage()

    def note(self, diagnostic: Diagnostic) -> None:
        """Print a diagnostic above the bar."""
        if self._show:
            text = str(diagnostic)
            self._console.print("".join(c if c.isprintable() else "?" for c in text), markup=False)

    def momentum(self, step: int, steps: int, loss: float) -> None:
        """Show the progress of the momentum steps."""
        state = f"loss {loss:.3g}"
        self._show_stage("momentum", step, steps, state, f"{step} steps, {state}")

    def round(self, number: int, rounds: int, steps: int, rms: float) -> None:
        """Show the progress of a servo fit: outer iteration, steps in total, root mean square error [rad, m]."""
        state = f"{steps} steps, errors {1000 * rms:.3g} mrad"
        self._show_stage("servos", number, rounds, state, state)

    def epoch(self, record: Content, epochs: int) -> None:
        """Show the progress of the epochs: one record of metrics.jsonl; epochs: maximum number."""
        state = f"validation {record['validation']:.3g}, best {record['best']:.3g}"
        rate, epochs_done = record["step"] / record["seconds"], counted(record["epoch"], "epoch")
        line = f"{epochs_done}, loss {record['loss']:.3g}, {state}, {rate:.1f} steps/s"
        self._show_stage("training", record["epoch"], epochs, state, line)

    def _show_stage(self, stage: str, done: int, total: int, state: str, line: str) -> None:
        """Show the state of a stage in the bar; without a terminal, print the line at the end of the stage."""
        if not self._line.startswith(stage):
            self._end_stage()
            self._bar.reset(self._task, description=stage, total=total, visible=True)
        self._bar.update(self._task, completed=done, state=state)
        self._line = f"{stage}: {line}"

    def _end_stage(self) -> None:
        if self._line and self._show and not self._console.is_terminal:
            self._console.print(self._line, markup=False)
        self._line = ""
