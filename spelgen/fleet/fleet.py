"""Run a fleet from its file to its report: logs, then runs.

What has ended is on disk and is not done again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any, Protocol, TypeVar

from spelgen.errors import RunError, SpelgenError
from spelgen.files import write_json
from spelgen.fleet.jobs import Job, RunResult, run_job
from spelgen.fleet.prepare import Preparation, PreparedArm, prepare
from spelgen.fleet.schema import Fleet
from spelgen.tasks import RunTasks

SCHEMA = 1


class Named(Protocol):
    """A task with a name for people."""

    @property
    def name(self) -> str:
        """Return the name."""
        ...


Task = TypeVar("Task", bound=Named)
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
    runner = _Runner(run_tasks, note)
    arms = _prepare(fleet, folder, runner)
    # arm by arm, so that the first rankings can be read while the rest runs
    choices = product(arms.values(), fleet.presets, range(fleet.seeds), range(fleet.splits))
    jobs = [_job(fleet, folder, *choice) for choice in choices]
    fleet_results = FleetResults(runner.results(jobs), runner.failures)
    write_json(folder / "fleet.json", fleet_results.to_dict())
    return fleet_results


class _Runner:
    """Run tasks, say how each ended, and keep the failures."""

    def __init__(self, run_tasks: RunTasks, note: Callable[[str], None]) -> None:
        self._run_tasks, self._note = run_tasks, note
        self.failures: dict[str, str] = {}

    def outcomes(
        self, phase: str, work: Callable[[Task], Result], tasks: Sequence[Task]
    ) -> Iterator[tuple[Task, Result | Exception]]:
        """Yield each task with its result, or the exception it ended with."""
        for number, (task, outcome) in enumerate(self._run_tasks(work, tasks), start=1):
            failure = ""
            if isinstance(outcome, Exception):
                failure = f": failed: {one_line(outcome)}"
            self._note(f"{phase} {number}/{len(tasks)}: {task.name}{failure}")
            yield task, outcome

    def results(self, jobs: Sequence[Job]) -> list[RunResult]:
        """Return the results in the order of the jobs, those that are done not run again; failures are kept."""
        results = {job.name: job.result() for job in jobs}
        waiting = [job for job in jobs if results[job.name] is None]
        for job, outcome in self.outcomes("training", run_job, waiting):
            if isinstance(outcome, Exception):
                self.failures[job.name] = one_line(outcome)
            else:
                results[job.name] = outcome
        return [result for result in results.values() if result is not None]


def _prepare(fleet: Fleet, folder: Path, runner: _Runner) -> dict[str, PreparedArm]:
    """Return, by name, the arms whose logs are ready. Raises RunError where there is none."""
    preparations = [
        Preparation(name, robot, fleet.splits, folder / "logs" / name) for name, robot in fleet.robots.items()
    ]
    arms = {}
    for preparation, outcome in runner.outcomes("logs", prepare, preparations):
        if isinstance(outcome, Exception):
            runner.failures[preparation.name] = one_line(outcome)
        else:
            arms[preparation.name] = outcome
    if not arms:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in runner.failures.items())
        raise RunError(f"no arm whose logs can be used ({reasons})")
    return {name: arms[name] for name in fleet.robots if name in arms}


def _job(fleet: Fleet, folder: Path, arm: PreparedArm, preset: str, seed: int, split: int) -> Job:
    robot, label = fleet.robots[arm.name], Path(preset).stem
    training, testing = arm.data[split]
    return Job(
        robot=arm.name,
        preset=label,
        seed=seed,
        split=split,
        folder=folder / "runs" / arm.name / f"{label}-seed{seed}-split{split}",
        urdf=robot.urdf,
        train=training,
        test=testing,
        data=arm.key,
        mapping=arm.mapping,
        joints=robot.joints,
        tip=robot.tip,
        design=preset,
        width=fleet.width,
        depth=fleet.depth,
        training=fleet.training,
        device="cuda" if fleet.gpus else "cpu",
    )


def one_line(error: Exception) -> str:
    """Return an exception in one line."""
    text = " ".join(str(error).split())
    if isinstance(error, SpelgenError):
        return text
    return f"unexpected {type(error).__name__}: {text}"
