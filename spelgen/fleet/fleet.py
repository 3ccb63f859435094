"""Run a fleet from its file to its report: logs, then runs.

What has ended is on disk and is not done again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any, TypeVar

from spelgen.errors import RunError, SpelgenError, in_one_line
from spelgen.files import write_json
from spelgen.fleet.jobs import Job, RunResult, run_job
from spelgen.fleet.prepare import Preparation, prepare
from spelgen.fleet.schema import Fleet
from spelgen.tasks import RunTasks

SCHEMA = 1


Task = TypeVar("Task", Preparation, Job)
Result = TypeVar("Result")


@dataclass(frozen=True)
class FleetResults:
    """Hold all results. results: of each run that ended, once. failures: by run, what went wrong."""

    results: list[RunResult]
    failures: dict[str, str]

    def to_dict(self) -> dict[str, Any]:
        """Return the content of fleet.json."""
        return {"schema": SCHEMA, **asdict(self)}


def run_fleet(fleet: Fleet, folder: Path, run_tasks: RunTasks, note: Callable[[str], None]) -> FleetResults:
    """Run what is not yet done and gather all; fleet.json in the folder then holds what is returned.

    note: hears of each task that ends. A run that fails is left out; started again, it is tried again. Raises RunError
    where no arm has logs that can be used.
    """
    failures: dict[str, str] = {}

    def succeeded(
        phase: str, work: Callable[[Task], Result], tasks: Sequence[Task]
    ) -> Iterator[tuple[Task, Result]]:
        """Yield each task that did not fail with its result, as they end."""
        for number, (task, outcome) in enumerate(run_tasks(work, tasks), start=1):
            heading = f"{phase} {number}/{len(tasks)}: {task.name}"
            if isinstance(outcome, Exception):
                failures[task.name] = _one_line(outcome)
                note(f"{heading}: failed: {failures[task.name]}")
            else:
                note(heading)
                yield task, outcome

    preparations = []
    for name, robot in fleet.robots.items():
        preparations.append(Preparation(name, robot, fleet.splits, folder / "logs" / name))
    prepared = {}
    for preparation, splits in succeeded("logs", prepare, preparations):
        prepared[preparation.name] = splits
    logs = {name: prepared[name] for name in fleet.robots if name in prepared}
    if not logs:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in failures.items())
        raise RunError(f"no arm whose logs can be used ({reasons})")
    # arm by arm, so that the first rankings can be read while the rest runs
    jobs = []
    for name, design, seed, split in product(logs, fleet.presets, range(fleet.seeds), range(fleet.splits)):
        run = folder / "runs" / name / f"{Path(design).stem}-seed{seed}-split{split}"
        job = Job(
            fleet=fleet, robot=name, design=design, seed=seed, split=split, logs=logs[name][split], folder=run
        )  # fmt: skip
        jobs.append(job)
    results = {job.name: job.result() for job in jobs}
    waiting = [job for job in jobs if results[job.name] is None]
    for job, result in succeeded("training", run_job, waiting):
        results[job.name] = result
    fleet_results = FleetResults([result for result in results.values() if result is not None], failures)
    write_json(folder / "fleet.json", fleet_results.to_dict())
    return fleet_results


def _one_line(error: Exception) -> str:
    if isinstance(error, SpelgenError):
        return " ".join(str(error).split())
    return f"unexpected {in_one_line(error)}"
