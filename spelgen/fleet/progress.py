"""What a person sees of a fleet: a table that changes, or a line for each phase where there is no terminal."""

from __future__ import annotations

import time
from collections.abc import Sequence
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table

from spelgen.fleet.jobs import Job
from spelgen.labels import printable


class FleetProgress:
    """A context that shows a fleet on stderr: how many runs of each arm and preset have ended, go on and failed."""

    def __init__(self) -> None:
        self._console = Console(stderr=True, highlight=False, soft_wrap=True)
        self._phase, self._since, self._tasks = "", 0.0, list[Any]()
        self._outcomes: dict[int, Any] = {}
        self._live = Live(
            console=self._console, get_renderable=self._table, refresh_per_second=1, transient=True
        )

    def __enter__(self) -> FleetProgress:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end_phase()
        self._live.stop()

    def phase(self, name: str, jobs: Sequence[Any]) -> None:
        """See ``Watch``."""
        self._end_phase()
        self._phase, self._since, self._tasks, self._outcomes = name, time.monotonic(), list(jobs), {}

    def ended(self, job: Any, outcome: Any) -> None:
        """See ``Watch``."""
        self._outcomes[id(job)] = outcome
        if isinstance(outcome, Exception):
            text = " ".join(str(outcome).split())
            self._console.print(f"failed: {printable(job.name)}: {printable(text)}", markup=False)

    def _end_phase(self) -> None:
        if self._tasks:
            failed = sum(isinstance(x, Exception) for x in self._outcomes.values())
            took = f"{time.monotonic() - self._since:.0f} s"
            done = (
                f"{self._phase}: {len(self._outcomes)} of {len(self._tasks)} ended, {failed} failed, {took}"
            )
            self._console.print(done, markup=False)
        self._tasks = []

    def _table(self) -> Table:
        table = Table(title=self._phase, box=None)
        for head in ("", "ended", "going on", "failed", "all"):
            table.add_column(head, justify="left" if not head else "right")
        groups: dict[str, list[Any]] = {}
        for task in self._tasks:
            groups.setdefault(
                f"{task.robot}, {task.preset}" if isinstance(task, Job) else self._phase, []
            ).append(task)
        for name, tasks in groups.items():
            outcomes = [self._outcomes[id(x)] for x in tasks if id(x) in self._outcomes]
            failed = sum(isinstance(x, Exception) for x in outcomes)
            waiting = [x for x in tasks if id(x) not in self._outcomes and isinstance(x, Job)]
            running = sum((x.folder / ".lock").exists() for x in waiting)
            table.add_row(printable(name), *map(str, (len(outcomes) - failed, running, failed, len(tasks))))
        return table
