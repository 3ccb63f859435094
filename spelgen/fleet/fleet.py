"""A fleet's run from its file to its report: logs, a search where one is asked for, runs, units that learn from one
another. What has ended is on disk and is not done again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from spelgen.errors import RunError, SpelgenError
from spelgen.files import write_json
from spelgen.fleet.engine import Engine
from spelgen.fleet.jobs import Job, run_job, with_options
from spelgen.fleet.prepare import Preparation, Prepared, prepare
from spelgen.fleet.schema import Fleet
from spelgen.fleet.units import Units, pooled_jobs, unit_jobs, units_of

if TYPE_CHECKING:
    from spelgen.fleet.search import Found

SCHEMA = 1


class Watch(Protocol):
    """Who is told how far a fleet is."""

    def phase(self, name: str, jobs: Sequence[Any]) -> None:
        """These jobs begin, or preparations."""
        ...

    def ended(self, job: Any, outcome: Any) -> None:
        """One of them has ended, with a result or an exception."""
        ...


@dataclass(frozen=True)
class FleetResults:
    """What was found. results: of each run that ended, once. failures: by run, what went wrong. found: of the search,
    by arm and preset. units: arms of the same URDF, compared.
    """

    results: list[dict[str, Any]]
    failures: dict[str, str]
    found: dict[tuple[str, str], Found] = field(default_factory=dict)
    units: tuple[Units, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """fleet.json."""
        return {
            "schema": SCHEMA,
            "results": self.results,
            "failures": self.failures,
            "search": [
                {
                    "robot": robot,
                    "preset": preset,
                    "options": x.options,
                    "validation": x.loss,
                    "trials": x.trials,
                }
                for (robot, preset), x in self.found.items()
            ],
            "units": [each.to_dict() for each in self.units],
        }


def run_fleet(fleet: Fleet, folder: Path, engine: Engine, watch: Watch) -> FleetResults:
    """Run what is not yet done and gather all; fleet.json in the folder then holds what is returned.

    A run that fails is told and left out; started again, it is tried again.
    """
    run = _Fleet(fleet, folder, engine, watch)
    prepared = run.prepared()
    starts = [run.job(arm, preset, 0, 0) for arm in prepared.values() for preset in fleet.presets]
    found = run.searched(starts)
    jobs = [
        with_options(
            run.job(arm, preset, seed, split), found[arm.name, label(preset)].options if found else {}
        )
        for arm in prepared.values()
        for preset in fleet.presets
        for seed in range(fleet.seeds)
        for split in range(fleet.splits)
    ]
    results = run.results("training", jobs)
    units: list[Units] = []
    if fleet.shared:
        own = [job for job in jobs if job.preset == "closed-form" and job.seed == 0 and job.result()]
        pooled = pooled_jobs(own, prepared, folder)
        results += run.results("pooling", pooled)
        of_units = unit_jobs(own, [job for job in pooled if job.result()], prepared)
        results += run.results("units", of_units)
        units = units_of(own, pooled, prepared, fleet)
    everything = FleetResults(results, run.failures, found, tuple(units))
    write_json(folder / "fleet.json", everything.to_dict())
    return everything


def label(preset: str) -> str:
    """How a preset is called: by its name, or that of its file."""
    return Path(preset).stem


class _Fleet:
    def __init__(self, fleet: Fleet, folder: Path, engine: Engine, watch: Watch) -> None:
        self.fleet, self.folder, self.engine, self.watch = fleet, folder, engine, watch
        self.failures: dict[str, str] = {}

    def prepared(self) -> dict[str, Prepared]:
        """By name the arms whose logs are ready. Raises RunError where there is none."""
        wanted = [
            Preparation(name, robot, self.fleet.splits, self.folder / "logs" / name)
            for name, robot in self.fleet.robots.items()
        ]
        found = {each.name: arm for each, arm in self._done("logs", prepare, wanted)}
        if not found:
            told = "; ".join(f"{name}: {why}" for name, why in self.failures.items())
            raise RunError(f"no arm whose logs can be used ({told})")
        return {name: found[name] for name in self.fleet.robots if name in found}

    def job(self, arm: Prepared, preset: str, seed: int, split: int) -> Job:
        """A run of this arm."""
        robot, fleet = self.fleet.robots[arm.name], self.fleet
        training, testing = arm.data[split]
        return Job(
            robot=arm.name, preset=label(preset), seed=seed, split=split,
            folder=self.folder / "runs" / arm.name / f"{label(preset)}-seed{seed}-split{split}",
            urdf=robot.urdf, train=training, test=testing, data=arm.key, mapping=arm.mapping,
            joints=robot.joints, tip=robot.tip, design=preset, width=fleet.width, depth=fleet.depth,
            training=fleet.training, device="cuda" if fleet.gpus else "cpu",
        )  # fmt: skip

    def searched(self, starts: Sequence[Job]) -> dict[tuple[str, str], Found]:
        """What the search chose for each arm and preset; nothing where none is asked for."""
        if self.fleet.search is None:
            return {}
        from spelgen.fleet.search import searched  # needs Optuna

        return searched(self.fleet.search, starts, lambda jobs: self.all("search", jobs))

    def all(self, phase: str, jobs: Sequence[Job]) -> Iterator[tuple[Job, Any]]:
        """Each job with its result, or the exception it ended with; those that are done are not run."""
        waiting = [job for job in jobs if job.result() is None]
        yield from ((job, done) for job in jobs if (done := job.result()) is not None)
        yield from self._each(phase, run_job, waiting)

    def results(self, phase: str, jobs: Sequence[Job]) -> list[dict[str, Any]]:
        """Results in the order of the jobs; failures are kept apart."""
        for job, outcome in self.all(phase, jobs):
            if isinstance(outcome, Exception):
                self.failures[job.name] = told(outcome)
        return [done for job in jobs if (done := job.result()) is not None]

    def _done(
        self, phase: str, work: Callable[[Any], Any], tasks: Sequence[Any]
    ) -> Iterator[tuple[Any, Any]]:
        for task, outcome in self._each(phase, work, tasks):
            if isinstance(outcome, Exception):
                self.failures[task.name] = told(outcome)
            else:
                yield task, outcome

    def _each(
        self, phase: str, work: Callable[[Any], Any], tasks: Sequence[Any]
    ) -> Iterator[tuple[Any, Any]]:
        if tasks:
            self.watch.phase(phase, tasks)
        for task, outcome in self.engine.results(work, tasks):
            self.watch.ended(task, outcome)
            yield task, outcome


def told(error: Exception) -> str:
    """An exception in one line."""
    text = " ".join(str(error).split())
    return text if isinstance(error, SpelgenError) else f"unexpected {type(error).__name__}: {text}"
