"""A comparison from its arms to its results: prepare the inputs, estimate the time, run what is not finished."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import torch

from spelgen.comparison.arms import Comparison
from spelgen.comparison.figures import spread_windows
from spelgen.comparison.inputs import ArmInputs, Progress, arm_inputs
from spelgen.comparison.jobs import Job, RunResult, run_job
from spelgen.comparison.tuning import ComparisonTuning
from spelgen.design import PRESET_NAMES, load_design
from spelgen.errors import RunError, SpelgenError, in_one_line
from spelgen.evaluation.plain import record
from spelgen.files import write_json
from spelgen.fitting.rollout import loss_scales, rollout_loss
from spelgen.labels import counted
from spelgen.settings.fits import DEFAULTS
from spelgen.settings.settings import load_settings
from spelgen.tasks import RunTasks

TUNING = ComparisonTuning()
SCHEMA = 1
PRESETS_ON_LOGS = ("closed-form", "hybrid")


@dataclass(frozen=True)
class Study:
    """A comparison that is ready to run.

    jobs: all runs. results: those that are finished, by the name of the run. failures: reason, by the name of an arm or
    run. step_seconds: time of a training step [s], by simulated arm and preset. estimates: time of a run [s], by name.
    """

    folder: Path
    jobs: tuple[Job, ...]
    results: dict[str, RunResult]
    failures: dict[str, str]
    step_seconds: dict[str, dict[str, float]]
    estimates: dict[str, float]

    @property
    def arms(self) -> dict[str, list[RunResult]]:
        """Return the results of each arm, in the order of the jobs."""
        arms: dict[str, list[RunResult]] = {}
        for job in self.jobs:
            if job.name in self.results:
                arms.setdefault(job.arm, []).append(self.results[job.name])
        return arms

    def announcement(self, parallel: int) -> str:
        """Return the number of runs, and an estimate of the time of those that are not finished."""
        counts = [
            counted(len({job.arm for job in self.jobs}), "arm"),
            counted(len({job.design for job in self.jobs}), "preset"),
            counted(len({job.seed for job in self.jobs}), "seed"),
            counted(len({job.split for job in self.jobs}), "split"),
        ]
        text = f"{counted(len(self.jobs), 'run')} ({', '.join(counts)})"
        if self.results:
            text += f", {len(self.results)} finished before"
        left = [self.estimates[job.name] for job in self.jobs if job.name not in self.results]
        if not left:
            return text
        # runs in parallel end together at best, and no earlier than the longest run
        return f"{text}; estimated time {duration(max(sum(left) / parallel, *left, 0.0))}"


def prepare_study(comparison: Comparison, folder: Path, progress: Progress | None = None) -> Study:
    """Prepare the inputs of all arms, find finished runs, and estimate the time of the others.

    An arm whose inputs cannot be prepared is a failure. Raises SettingsError for a preset that does not exist,
    RunError if no arm can be used, and the error of a single arm.
    """
    for preset in comparison.presets or ():
        load_design(preset)
    jobs: list[Job] = []
    failures: dict[str, str] = {}
    for name, arm in comparison.arms.items():
        try:
            inputs = arm_inputs(arm, comparison, folder / "arms" / name, progress)
            jobs += _jobs(name, inputs, comparison, folder / "runs" / name)
        except SpelgenError as error:
            if len(comparison.arms) == 1:
                raise
            failures[name] = _reason(error)
    if not jobs:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in failures.items())
        raise RunError(f"no arm that can be compared ({reasons})")
    results = {}
    for job in jobs:
        result = job.result()
        if result is not None:
            results[job.name] = result
    steps = _step_seconds(jobs)
    estimates = {job.name: _estimate(job, results, steps) for job in jobs}
    return Study(folder, tuple(jobs), results, failures, steps, estimates)


def run_study(study: Study, run_tasks: RunTasks, note: Callable[[str], None]) -> Study:
    """Run the jobs that are not finished and return the study with their results; comparison.json has these too.

    note: called with a line for each run that ends. A run with an error is a failure; the same command runs it again.
    """
    waiting = [job for job in study.jobs if job.name not in study.results]
    results, failures = dict(study.results), dict(study.failures)
    start, done, total = time.monotonic(), 0.0, sum(study.estimates[job.name] for job in waiting)
    for number, (job, outcome) in enumerate(run_tasks(run_job, waiting), start=1):
        done += study.estimates[job.name]
        line = f"{number}/{len(waiting)} {job.name}: "
        if isinstance(outcome, Exception):
            failures[job.name] = _reason(outcome)
            line += f"failed: {failures[job.name]}"
        else:
            results[job.name] = outcome
            line += _outcome(outcome)
        if number < len(waiting):
            line += f"; about {duration((time.monotonic() - start) * (total / done - 1))} left"
        note(line)
    finished = replace(study, results=results, failures=failures)
    content = {
        "schema": SCHEMA,
        "failures": failures,
        "results": list(map(_figures, finished.results.values())),
    }
    write_json(study.folder / "comparison.json", content)
    return finished


def duration(seconds: float) -> str:
    """Return a time in words, such as `40 s`, `12 min` or `3.5 h`."""
    if seconds < 90:
        return f"{max(seconds, 1):.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _jobs(name: str, inputs: ArmInputs, comparison: Comparison, folder: Path) -> list[Job]:
    """Return the runs of an arm, seed by seed, so that an interrupted comparison has all presets of the first seeds."""
    source = inputs.truth or inputs.urdf
    settings = load_settings(source)
    protocol = settings.comparison
    simulated = inputs.truth is not None
    training = comparison.training
    changes = {option: getattr(training, option) for option in training.model_fields_set}
    presets = comparison.presets or (PRESET_NAMES if simulated else PRESETS_ON_LOGS)
    seeds = comparison.seeds or (protocol.seeds if simulated else 1)
    jobs = []
    for seed, split, design in product(range(seeds), range(comparison.splits), presets):
        job = Job(
            arm=name, inputs=inputs, design=design, seed=seed, split=split, splits=comparison.splits,
            width=comparison.width or protocol.width, depth=comparison.depth or protocol.depth,
            training=settings.training.model_copy(update=changes),
            protocol=protocol.model_copy(update={"steps": comparison.steps or protocol.steps}),
            default_training=comparison.urdf_error is not None,
            folder=folder / f"{Path(design).stem}-seed{seed}-split{split}",
        )  # fmt: skip
        jobs.append(job)
    return jobs


def _step_seconds(jobs: Sequence[Job]) -> dict[str, dict[str, float]]:
    """Return the median time of a loss and its gradient [s], without the optimizer, by simulated arm and preset."""
    times: dict[str, dict[str, float]] = {}
    torch.set_num_threads(1)
    for job in jobs:
        if job.inputs.truth is None or job.preset in times.setdefault(job.arm, {}):
            continue
        model, config = job.build(), job.equal_steps()
        training, _ = job.inputs.split(job.split, job.splits)
        decimation = job.training.decimation or 1
        windows = spread_windows(training, config.window, decimation)[: config.batch or DEFAULTS.batch]
        scales = loss_scales(windows, model.joint_types)
        durations = []
        for _ in range(TUNING.timed_steps):
            start = time.perf_counter()
            model.zero_grad()
            torch.autograd.backward(rollout_loss(model, windows, scales, 1))
            durations.append(time.perf_counter() - start)
        times[job.arm][job.preset] = statistics.median(durations)
    return times


def _estimate(job: Job, results: Mapping[str, RunResult], steps: Mapping[str, Mapping[str, float]]) -> float:
    """Return the expected time of a run [s]: of finished runs of this arm and preset, else of its training steps."""
    alike = [x.seconds for x in results.values() if (x.arm, x.preset) == (job.arm, job.preset)]
    if alike:
        return statistics.median(alike) + TUNING.measuring
    if job.inputs.truth is None:
        return TUNING.run_on_logs
    count = job.protocol.steps + TUNING.momentum_cost * job.protocol.momentum_steps
    return count * steps[job.arm][job.preset] + TUNING.measuring


def _outcome(result: RunResult) -> str:
    """Return the first figure of a run and its time."""
    measure, errors = next(iter(result.errors.items()))
    error = errors["model"]
    return f"{measure} {'not finite' if error is None else f'{error:.3g}'}, {result.seconds:.0f} s"


def _figures(result: RunResult) -> dict[str, object]:
    """Return the JSON form of a result without its curves, which result.json has."""
    figures = record(result)
    for curves in ("mass", "example"):
        (figures["simulated"] or {}).pop(curves, None)
    return figures


def _reason(error: Exception) -> str:
    if isinstance(error, SpelgenError):
        return " ".join(str(error).split())
    return f"unexpected {in_one_line(error)}"
