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
from spelgen.fleet.prepare import Preparation, PreparedArm, prepare
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
    progress = _Progress(run_tasks, note)
    arms = _prepare(fleet, folder, progress)
    # arm by arm, so that the first rankings can be read while the rest runs
    results: dict[str, RunResult | None] = {}
    waiting: list[Job] = []
    for choice in product(arms, fleet.presets, range(fleet.seeds), range(fleet.splits)):
        job = _job(fleet, folder, *choice)
        results[job.name] = job.result()
        if results[job.name] is None:
            waiting.append(job)
    for job, result in progress.succeeded("training", run_job, waiting):
        results[job.name] = result
    ended = [result for result in results.values() if result is not None]
    fleet_results = FleetResults(ended, progress.failures)
    write_json(folder / "fleet.json", fleet_results.to_dict())
    return fleet_results


class _Progress:
    """Run tasks, say how each ended, and keep the failures."""

    def __init__(self, run_tasks: RunTasks, note: Callable[[str], None]) -> None:
        self._run_tasks, self._note = run_tasks, note
        self.failures: dict[str, str] = {}

    def succeeded(
        self, phase: str, work: Callable[[Task], Result], tasks: Sequence[Task]
    ) -> Iterator[tuple[Task, Result]]:
        """Yield each task that did not fail with its result, as they end."""
        for number, (task, outcome) in enumerate(self._run_tasks(work, tasks), start=1):
            heading = f"{phase} {number}/{len(tasks)}: {task.name}"
            if isinstance(outcome, Exception):
                self.failures[task.name] = one_line(outcome)
                self._note(f"{heading}: failed: {self.failures[task.name]}")
            else:
                self._note(heading)
                yield task, outcome


def _prepare(fleet: Fleet, folder: Path, progress: _Progress) -> list[PreparedArm]:
    """Return the arms whose logs are ready, in the order of the fleet. Raises RunError where there is none."""
    preparations = []
    for name, robot in fleet.robots.items():
        preparations.append(Preparation(name, robot, fleet.splits, folder / "logs" / name))
    arms = {}
    for preparation, arm in progress.succeeded("logs", prepare, preparations):
        arms[preparation.name] = arm
    if not arms:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in progress.failures.items())
        raise RunError(f"no arm whose logs can be used ({reasons})")
    return [arms[name] for name in fleet.robots if name in arms]


def _job(fleet: Fleet, folder: Path, arm: PreparedArm, preset: str, seed: int, split: int) -> Job:
    robot, label = fleet.robots[arm.name], Path(preset).stem
    training, testing = arm.data[split]
    return Job(
        robot=arm.name,
        preset=label,
        seed=seed,
        split=split,
        folder=folder / "runs" / arm.name / f"{label}-seed{seed}-split{split}",
        train=training,
        test=testing,
        data=arm.key,
        mapping=arm.mapping,
        design=preset,
        training=fleet.training,
        **robot.model_dump(include={"urdf", "joints", "tip"}),
        **fleet.model_dump(include={"width", "depth"}),
    )


def one_line(error: Exception) -> str:
    """Return an exception in one line."""
    if isinstance(error, SpelgenError):
        return " ".join(str(error).split())
    return f"unexpected {in_one_line(error)}"
