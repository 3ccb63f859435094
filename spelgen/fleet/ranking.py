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
    tables = []
    for robot, runs in _by_robot(fleet).items():
        tables.append(ranking(robot, runs))
    if fleet.failures:
        rows = []
        for name, reason in fleet.failures.items():
            rows.append((f"{name}: {reason}",))
        tables.append(Listing("Failed runs; the same command runs them again", ("",), tuple(rows)))
    return tables


def winners(fleet: FleetResults) -> dict[str, int]:
    """Return of how many arms each model is the best, the one that wins most first."""
    wins: dict[str, int] = {}
    for robot, runs in _by_robot(fleet).items():
        name = next(row[0] for row in ranking(robot, runs).rows if not row[0].startswith("("))
        wins[name] = wins.get(name, 0) + 1
    return dict(sorted(wins.items(), key=lambda item: -item[1]))


def ranking(robot: str, runs: Sequence[RunResult]) -> Listing:
    """Return one arm's models and baselines, the one that predicts best over the longest horizon first.

    Figures are medians over seeds and splits.
    """
    presets: dict[str, list[RunResult]] = {}
    for run in runs:
        presets.setdefault(run["preset"], []).append(run)
    horizons = _common(run["errors"] for run in runs)
    lines = []
    for preset, of_preset in presets.items():
        seconds = statistics.median(run["seconds"] for run in of_preset)
        facts = (f"{of_preset[0]['parameters']:,}", f"{len(of_preset):,}", number(seconds))
        lines.append(_Line(preset, _medians(of_preset, MODEL, horizons), facts))
    # judged at every horizon, or by torque
    for name in _common([*_common(run["errors"].values()), *run["torque"]] for run in runs):
        if name != MODEL:
            lines.append(_Line(f"({name})", _medians(runs, name, horizons)))
    # baselines stand among the models: a model below one of them is not worth its training
    lines.sort(key=lambda line: line.order)
    head = ("", *horizons, "nMSE", "parameters", "runs", "time [s]")
    return Listing(f"{robot}, best first: {MEASURE}; medians of all runs", head, tuple(x.row for x in lines))


@dataclass(frozen=True)
class _Line:
    """A model or a baseline: errors by horizon, then nMSE of torques. facts: parameters, runs and seconds a run."""

    name: str
    errors: tuple[float, ...]
    facts: tuple[str, str, str] = ("-", "-", "-")

    @property
    def order(self) -> tuple[float, ...]:
        """Return what lines are sorted by: errors, of the longest horizon first, then of torque."""
        *horizons, torque = self.errors
        return (*reversed(horizons), torque)

    @property
    def row(self) -> tuple[str, ...]:
        """Return the line as text."""
        return (self.name, *map(number, self.errors), *self.facts)


def _medians(runs: Sequence[RunResult], predictor: str, horizons: Sequence[str]) -> tuple[float, ...]:
    """Return the median error of each horizon, then of torques."""
    columns: dict[str, list[float]] = {}
    for run in runs:
        errors = dict.fromkeys(horizons)
        for horizon in horizons:
            errors[horizon] = run["errors"][horizon].get(predictor)
        errors["torque"] = run["torque"].get(predictor)
        for name, error in errors.items():
            # an error that is not finite counts as infinitely bad
            columns.setdefault(name, []).append(math.inf if error is None else error)
    return tuple(map(statistics.median, columns.values()))


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
