"""Optuna's search over training options for every arm and preset: rounds of trials, each a run of the fleet.

Nothing of it is stored but the trials' results: the sampler is seeded and told of results in a fixed order, so that it
proposes the same trials again, of which those that were run are there. Trials are judged by their validation loss: test
logs stay unseen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import optuna

from spelgen.fleet.jobs import Job, with_options
from spelgen.fleet.schema import Range, Search

Outcome = Mapping[str, Any] | Exception
RunAll = Callable[[Sequence[Job]], Iterator[tuple[Job, Outcome]]]


@dataclass(frozen=True)
class Found:
    """What a search found for one arm and preset. options: the best. loss: its validation loss. trials: that ended."""

    options: dict[str, Any]
    loss: float
    trials: int


def searched(search: Search, starts: Sequence[Job], run_all: RunAll) -> dict[tuple[str, str], Found]:
    """By arm and preset what is best among the options; ``starts``: a job of each, as it would be without a search."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    studies = [optuna.create_study(sampler=optuna.samplers.TPESampler(seed=0)) for _ in starts]
    for begin in range(0, search.trials, search.at_once):
        count = min(search.at_once, search.trials - begin)
        asked: dict[str, tuple[optuna.Study, optuna.trial.Trial]] = {}
        jobs = []
        for study, start in zip(studies, starts, strict=True):
            for _ in range(count):
                trial = study.ask()
                job = trial_job(
                    start, trial.number, {name: _drawn(trial, name, x) for name, x in search.over.items()}
                )
                asked[str(job.folder)] = (study, trial)
                jobs.append(job)
        ended = {str(job.folder): outcome for job, outcome in run_all(jobs)}
        for folder, (study, trial) in asked.items():
            study.tell(trial, _loss(ended[folder]))
    return {(x.robot, x.preset): _best(study) for x, study in zip(starts, studies, strict=True)}


def trial_job(start: Job, number: int, options: Mapping[str, Any]) -> Job:
    """The job with other options, beside the one it is a trial of."""
    folder = start.folder.with_name(f"{start.folder.name}-trial{number}")
    return replace(with_options(start, options), folder=folder, judged=False)


def _drawn(trial: optuna.trial.Trial, name: str, among: Range | Sequence[Any]) -> Any:
    if not isinstance(among, Range):
        return trial.suggest_categorical(name, list(among))
    if isinstance(among.low, int) and isinstance(among.high, int):
        return trial.suggest_int(name, among.low, among.high, log=among.log)
    return trial.suggest_float(name, among.low, among.high, log=among.log)


def _loss(outcome: Outcome) -> float:
    """A run that failed, or whose loss is not finite, is worse than any other."""
    loss = math.inf if isinstance(outcome, Exception) else float(outcome["validation"])
    return loss if math.isfinite(loss) else 1e300


def _best(study: optuna.Study) -> Found:
    return Found(dict(study.best_params), float(study.best_value), len(study.trials))
