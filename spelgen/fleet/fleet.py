"""Run a fleet from its file to its report: logs, a search where one is asked for, runs, units of the same arm.

What has ended is on disk and is not done again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from spelgen.errors import RunError, SpelgenError
from spelgen.files import write_json
from spelgen.fleet.jobs import Job, RunResult, run_job, with_options
from spelgen.fleet.prepare import Preparation, PreparedArm, prepare
from spelgen.fleet.schema import Fleet, Range, Search
from spelgen.fleet.tasks import RunTasks
from spelgen.fleet.units import Units, compare_units, pooled_jobs, unit_jobs

if TYPE_CHECKING:
    from optuna import Study
    from optuna.trial import Trial

SCHEMA = 1
FAILED_LOSS = 1e300  # of a run that failed: worse than any other, and finite, as the sampler needs it


class Named(Protocol):
    """A task with a name for people."""

    @property
    def name(self) -> str:
        """Return the name."""
        ...


Task = TypeVar("Task", bound=Named)
Result = TypeVar("Result")


@dataclass(frozen=True)
class SearchResult:
    """Hold the best options of a search for one arm and preset, their validation loss and how many trials ended."""

    robot: str
    preset: str
    options: dict[str, Any]
    validation: float
    trials: int


@dataclass(frozen=True)
class FleetResults:
    """Hold all results. results: of each run that ended, once. failures: by run, what went wrong. units: arms of the
    same URDF, compared.
    """

    results: list[RunResult]
    failures: dict[str, str]
    search: tuple[SearchResult, ...] = ()
    units: tuple[Units, ...] = ()

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
    starts = [_job(fleet, folder, arm, preset, 0, 0) for arm in arms.values() for preset in fleet.presets]
    search: tuple[SearchResult, ...] = ()
    if fleet.search is not None:
        search = search_options(fleet.search, starts, lambda jobs: runner.run("search", jobs))
    options = {(x.robot, x.preset): x.options for x in search}
    # arm by arm, so that the first rankings can be read while the rest runs
    jobs = []
    for arm, preset, seed, split in product(
        arms.values(), fleet.presets, range(fleet.seeds), range(fleet.splits)
    ):
        job = _job(fleet, folder, arm, preset, seed, split)
        jobs.append(with_options(job, options.get((job.robot, job.preset), {})))
    results = runner.results("training", jobs)
    units: list[Units] = []
    if fleet.shared:
        # seed 0 alone: fits of rigid bodies do not depend on seeds
        separate = [job for job in jobs if job.preset == "closed-form" and job.seed == 0 and job.result()]
        pooled = pooled_jobs(separate, arms, folder)
        results += runner.results("pooling", pooled)
        pooled = [job for job in pooled if job.result()]
        results += runner.results("units", unit_jobs(separate, pooled, arms))
        units = compare_units(separate, pooled, arms, fleet)
    fleet_results = FleetResults(results, runner.failures, search, tuple(units))
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

    def run(self, phase: str, jobs: Sequence[Job]) -> Iterator[tuple[Job, RunResult | Exception]]:
        """Yield each job with its result, or the exception it ended with; those that are done are not run."""
        waiting = []
        for job in jobs:
            result = job.result()
            if result is None:
                waiting.append(job)
            else:
                yield job, result
        yield from self.outcomes(phase, run_job, waiting)

    def results(self, phase: str, jobs: Sequence[Job]) -> list[RunResult]:
        """Return the results in the order of the jobs; failures are kept."""
        results = {}
        for job, outcome in self.run(phase, jobs):
            if isinstance(outcome, Exception):
                self.failures[job.name] = one_line(outcome)
            else:
                results[job.name] = outcome
        return [results[job.name] for job in jobs if job.name in results]


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


def search_options(
    search: Search,
    starts: Sequence[Job],
    run_jobs: Callable[[Sequence[Job]], Iterator[tuple[Job, Mapping[str, Any] | Exception]]],
) -> tuple[SearchResult, ...]:
    """Return what is best among the options; ``starts``: for each arm and preset a job as it is without a search.

    Nothing is stored but the trials' results: the sampler is seeded and told of results in a fixed order, so that it
    proposes the same trials again. Trials are judged by their validation loss: test logs stay unseen.
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    studies = [optuna.create_study(sampler=optuna.samplers.TPESampler(seed=0)) for _ in starts]
    for begin in range(0, search.trials, search.at_once):
        trials: dict[Path, tuple[Study, Trial]] = {}
        jobs = []
        for study, start in zip(studies, starts, strict=True):
            for _ in range(min(search.at_once, search.trials - begin)):
                trial = study.ask()
                options = {name: _drawn(trial, name, x) for name, x in search.over.items()}
                jobs.append(trial_job(start, trial.number, options))
                trials[jobs[-1].folder] = study, trial
        # workers end in any order; the sampler must hear of trials in the order in which it proposed them
        outcomes = {job.folder: outcome for job, outcome in run_jobs(jobs)}
        for folder, (study, trial) in trials.items():
            study.tell(trial, _loss(outcomes[folder]))
    best = []
    for start, study in zip(starts, studies, strict=True):
        result = dict(study.best_params), float(study.best_value), len(study.trials)
        best.append(SearchResult(start.robot, start.preset, *result))
    return tuple(best)


def trial_job(start: Job, number: int, options: Mapping[str, object]) -> Job:
    """Return the job with other options, in a folder beside that of the job it is a trial of."""
    folder = start.folder.with_name(f"{start.folder.name}-trial{number}")
    return with_options(start, options).model_copy(update={"folder": folder, "judged": False})


def _drawn(trial: Trial, name: str, candidates: Range | Sequence[Any]) -> object:
    if not isinstance(candidates, Range):
        return trial.suggest_categorical(name, list(candidates))
    low, high = candidates.low, candidates.high
    if isinstance(low, int) and isinstance(high, int):
        return trial.suggest_int(name, low, high, log=candidates.log)
    return trial.suggest_float(name, low, high, log=candidates.log)


def _loss(outcome: Mapping[str, Any] | Exception) -> float:
    if isinstance(outcome, Exception):
        return FAILED_LOSS
    loss = float(outcome["validation"])
    return loss if math.isfinite(loss) else FAILED_LOSS


def one_line(error: Exception) -> str:
    """Return an exception in one line."""
    text = " ".join(str(error).split())
    if isinstance(error, SpelgenError):
        return text
    return f"unexpected {type(error).__name__}: {text}"
