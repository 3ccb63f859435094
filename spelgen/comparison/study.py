"""Steps of a comparison: prepare the inputs of all arms, estimate the time, run the unfinished jobs."""

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import torch

from spelgen.comparison.arms import ArmInputs, Comparison, Progress, arm_inputs
from spelgen.comparison.figures import TUNING, step_seconds
from spelgen.comparison.jobs import Job, RunResult, run_job
from spelgen.design import load_design
from spelgen.errors import RunError, SpelgenError, in_one_line
from spelgen.evaluation.plain import record
from spelgen.files import write_json
from spelgen.labels import MODEL, counted
from spelgen.listing import duration, number
from spelgen.settings.settings import load_settings
from spelgen.tasks import run_tasks

PRESETS_ON_LOGS: tuple[str, ...] = ("closed-form", "hybrid")
# Presets that are compared on simulated logs. The models of the paper (Wang et al., Sci Rep 15:33179, 2025) are first.
SIMULATED_PRESETS: tuple[str, ...] = ("phnode", "spel", "spel-kan", "minimal", "hybrid", "closed-form")


@dataclass(frozen=True)
class Study:
    """A comparison that is ready to run.

    jobs: all runs. results: {name of a finished run: result}. failures: {name of an arm or run: reason}. estimates:
    {name of an unfinished run: expected duration [s]}.
    """

    folder: Path
    jobs: tuple[Job, ...]
    results: dict[str, RunResult]
    failures: dict[str, str]
    estimates: dict[str, float]

    def announcement(self, parallel: int) -> str:
        """Return a text with the number of runs, such as "12 runs (2 arms, 3 presets, ...)", and the estimated time.

        The time is an estimate for all unfinished runs, `parallel` of which run at the same time.
        """
        dimensions = zip(*((job.arm, job.design, job.seed, job.split) for job in self.jobs), strict=True)
        nouns = ("arm", "preset", "seed", "split")
        counts = [counted(len(set(values)), noun) for values, noun in zip(dimensions, nouns, strict=True)]
        text = f"{counted(len(self.jobs), 'run')} ({', '.join(counts)})"
        if self.results:
            text += f", {len(self.results)} finished before"
        if not self.estimates:
            return text
        # The estimated time assumes that all workers are equally loaded. The estimate is at least the time of the
        # longest run.
        seconds = max(sum(self.estimates.values()) / parallel, *self.estimates.values(), 0.0)
        return f"{text}; estimated time {duration(seconds)}"


def prepare_study(comparison: Comparison, folder: Path, progress: Progress | None = None) -> Study:
    """Prepare the inputs of all arms, find finished runs, and estimate the duration of the unfinished runs.

    An arm whose inputs cannot be prepared becomes an entry of `Study.failures`. Raises SettingsError for a preset that
    does not exist, and RunError if no arm can be used. If there is only one arm, its error is raised.
    """
    # Presets are checked first, so that a misspelt name is an error before logs are simulated.
    for preset in comparison.presets or ():
        load_design(preset)
    jobs = []
    failures = {}
    for name, arm in comparison.arms.items():
        try:
            inputs = arm_inputs(arm, folder / "arms" / name, comparison.splits, progress)
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
    waiting = [job for job in jobs if job.name not in results]
    # Time is estimated once per arm and preset, as runs that differ only in seed or split take about equally long.
    models = {(job.arm, job.preset): job for job in reversed(waiting)}
    seconds = {model: _estimate(job, results) for model, job in models.items()}
    estimates = {job.name: seconds[job.arm, job.preset] for job in waiting}
    return Study(folder, tuple(jobs), results, failures, estimates)


def run_study(study: Study, note: Callable[[str], None], jobs: int = 1, address: str | None = None) -> Study:
    """Run the unfinished jobs of ``study``, write comparison.json and return the study with all results.

    A job with an error becomes a failure of the study; the same command runs the job again. note: function called with
    a line of text after each job. jobs: number of parallel jobs. address: address of a Ray cluster, see `run_tasks`.
    """
    waiting = [job for job in study.jobs if job.name in study.estimates]
    results, failures = dict(study.results), dict(study.failures)
    start, done, total = time.monotonic(), 0.0, sum(study.estimates.values())
    for count, (job, outcome) in enumerate(run_tasks(run_job, waiting, jobs, address), start=1):
        # Progress is measured in estimated seconds and not in runs, because presets differ in cost.
        done += study.estimates[job.name]
        if isinstance(outcome, Exception):
            failures[job.name] = _reason(outcome)
            line = f"failed: {failures[job.name]}"
        else:
            results[job.name] = outcome
            measure, errors = next(iter(outcome.errors.items()))
            line = f"{measure} {number(errors[MODEL])}, {outcome.seconds:.0f} s"
        if count < len(waiting):
            line += f"; about {duration((time.monotonic() - start) * (total / done - 1))} left"
        note(f"{count}/{len(waiting)} {job.name}: {line}")
    finished = replace(study, results=results, failures=failures, estimates={})
    figures = list(map(record, results.values()))
    write_json(study.folder / "comparison.json", {"schema": 2, "failures": failures, "results": figures})
    return finished


def _jobs(name: str, inputs: ArmInputs, comparison: Comparison, folder: Path) -> list[Job]:
    """Return the runs of an arm, ordered by seed.

    In this order an interrupted comparison has results of all presets for the first seeds.
    """
    settings = load_settings(inputs.truth or inputs.urdf)
    protocol, simulated = settings.comparison, inputs.truth is not None
    presets = comparison.presets or (SIMULATED_PRESETS if simulated else PRESETS_ON_LOGS)
    seeds = comparison.seeds or (protocol.seeds if simulated else 1)
    options = {
        name: value for name, value in comparison.training if name in comparison.training.model_fields_set
    }
    shared = {
        "arm": name, "inputs": inputs, "runs": folder, "splits": comparison.splits,
        "width": comparison.width or protocol.width, "depth": comparison.depth or protocol.depth,
        "training": settings.training.model_copy(update=options),
        "protocol": protocol.model_copy(update={"steps": comparison.steps or protocol.steps}),
    }  # fmt: skip
    jobs = []
    for seed, split, design in product(range(seeds), range(comparison.splits), presets):
        jobs.append(Job.model_validate(shared | {"design": design, "seed": seed, "split": split}))
    return jobs


def _estimate(job: Job, results: Mapping[str, RunResult]) -> float:
    """Return the expected duration of a run [s].

    It is the median training time of finished runs of the same arm and preset, plus a constant for the evaluation. If
    there is no such run, the training time of a simulated arm is the number of training steps times the measured
    duration of a step; for logs of the user, the expected duration is a constant.
    """
    finished = [x.seconds for x in results.values() if (x.arm, x.preset) == (job.arm, job.preset)]
    if finished:
        return statistics.median(finished) + TUNING.measuring
    if job.inputs.truth is None:
        return TUNING.run_on_logs
    torch.set_num_threads(1)
    training, _ = job.inputs.split(job.split, job.splits)
    step = step_seconds(job.build(), training, job.equal_steps(), job.training.decimation or 1)
    return (job.protocol.steps + TUNING.momentum_cost * job.protocol.momentum_steps) * step + TUNING.measuring


def _reason(error: Exception) -> str:
    is_known = isinstance(error, SpelgenError)
    return " ".join(str(error).split()) if is_known else f"unexpected {in_one_line(error)}"
