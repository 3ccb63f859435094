"""Lay a fleet's results out in tables: models ranked for each arm."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from spelgen.baselines.names import MODEL
from spelgen.fleet.fleet import FleetResults
from spelgen.listing import Listing, number

RunResult = Mapping[str, Any]
MEASURE = "relative RMS after each time (0: no error, 1: as if the arm had stood still), nMSE of torques"


def fleet_listings(fleet: FleetResults) -> list[Listing]:
    """Return all tables of a fleet's report."""
    tables = [ranking(robot, runs) for robot, runs in _by_robot(fleet).items()]
    if fleet.failures:
        rows = tuple((f"{name}: {reason}",) for name, reason in fleet.failures.items())
        tables.append(Listing("Failed runs; the same command runs them again", ("",), rows))
    return tables


def winners(fleet: FleetResults) -> dict[str, int]:
    """Return of how many arms each model is the best, the one that wins most first."""
    wins: dict[str, int] = {}
    for robot, runs in _by_robot(fleet).items():
        names = [row[0] for row in ranking(robot, runs).rows if not row[0].startswith("(")]
        wins[names[0]] = wins.get(names[0], 0) + 1
    return dict(sorted(wins.items(), key=lambda item: -item[1]))


def ranking(robot: str, runs: Sequence[RunResult]) -> Listing:
    """Return one arm's models, the one that predicts best over the longest horizon first, and the baselines among them;
    medians over seeds and splits.
    """
    presets: dict[str, list[RunResult]] = {}
    for run in runs:
        presets.setdefault(run["preset"], []).append(run)
    horizons = _common(run["errors"] for run in runs)
    lines = [_model_line(name, of_preset, horizons) for name, of_preset in presets.items()]
    for name in _common(_predictors(run) for run in runs):
        if name != MODEL:
            lines.append(_line(f"({name})", runs, name, horizons))
    # baselines stand among the models: a model below one of them is not worth its training
    lines.sort(key=lambda line: line.order)
    head = ("", *horizons, "nMSE", "parameters", "runs", "time [s]")
    return Listing(f"{robot}, best first: {MEASURE}; medians of all runs", head, tuple(x.row for x in lines))


@dataclass(frozen=True)
class _Line:
    """A model or a baseline: errors by horizon, nMSE of torques; of models parameters, runs and seconds a run."""

    name: str
    errors: tuple[float | None, ...]
    torque: float | None
    parameters: int | None = None
    runs: int | None = None
    seconds: float | None = None

    @property
    def order(self) -> list[float]:
        """Return what lines are sorted by: errors, of the longest horizon first, then of torque."""
        values = (*reversed(self.errors), self.torque)
        return [math.inf if value is None else value for value in values]

    @property
    def row(self) -> tuple[str, ...]:
        """Return the line as text."""
        values = (*self.errors, self.torque, self.parameters, self.runs, self.seconds)
        return (self.name, *(_text(value) for value in values))


def _model_line(name: str, runs: Sequence[RunResult], horizons: Sequence[str]) -> _Line:
    line = _line(name, runs, MODEL, horizons)
    seconds = _median([run["seconds"] for run in runs])
    return _Line(name, line.errors, line.torque, runs[0]["parameters"], len(runs), seconds)


def _line(name: str, runs: Sequence[RunResult], predictor: str, horizons: Sequence[str]) -> _Line:
    errors = []
    for horizon in horizons:
        errors.append(_median([run["errors"][horizon].get(predictor) for run in runs]))
    return _Line(name, tuple(errors), _median([run["torque"].get(predictor) for run in runs]))


def _median(values: Sequence[float | None]) -> float | None:
    """Return the median, None where it is not finite; an error that is not finite counts as infinitely bad."""
    median = statistics.median(math.inf if value is None else value for value in values)
    return median if math.isfinite(median) else None


def _predictors(run: RunResult) -> list[str]:
    """Return the names of all predictors that are judged at every horizon, or by torque."""
    return [*_common(run["errors"].values()), *run["torque"]]


def _common(lists: Iterable[Iterable[str]]) -> list[str]:
    """Return the names that are in all lists, once, in the order of the first."""
    common: dict[str, None] | None = None
    for names in lists:
        if common is None:
            common = dict.fromkeys(names)
        else:
            common = dict.fromkeys(name for name in common if name in names)
    return list(common or ())


def _by_robot(fleet: FleetResults) -> dict[str, list[RunResult]]:
    robots: dict[str, list[RunResult]] = {}
    for run in fleet.results:
        robots.setdefault(run["robot"], []).append(run)
    return robots


def _text(value: float | None) -> str:
    if isinstance(value, int):
        return f"{value:,}"
    return number(value)
