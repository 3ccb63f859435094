"""Lay a fleet's results out in tables: models ranked for each arm."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from spelgen.baselines.names import MODEL
from spelgen.fleet.fleet import FleetResults
from spelgen.listing import Listing, number

RunResult = Mapping[str, Any]
MEASURE = "relative RMS after each time (0: no error, 1: as if the arm had stood still), nMSE of torques"


def fleet_listings(fleet: FleetResults) -> list[Listing]:
    """Return all tables of a fleet's report."""
    tables = [ranking(robot, runs) for robot, runs in _by_robot(fleet).items()]
    failures = tuple((f"{name}: {reason}",) for name, reason in fleet.failures.items())
    if failures:
        tables.append(Listing("Failed runs; the same command runs them again", ("",), failures))
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
    horizons = _common([run["errors"] for run in runs])
    lines = []
    for preset, of_preset in presets.items():
        seconds = statistics.median(run["seconds"] for run in of_preset)
        facts = (f"{of_preset[0]['parameters']:,}", f"{len(of_preset):,}", number(seconds))
        lines.append((_medians(of_preset, MODEL, horizons), preset, facts))
    # judged at every horizon, or by torque
    for name in _common([[*_common(list(run["errors"].values())), *run["torque"]] for run in runs]):
        if name != MODEL:
            lines.append((_medians(runs, name, horizons), f"({name})", ("-", "-", "-")))
    # baselines stand among the models: a model below one of them is not worth its training
    lines.sort(key=lambda line: line[0][-2::-1] + line[0][-1:])
    rows = tuple((name, *map(number, errors), *facts) for errors, name, facts in lines)
    head = ("", *horizons, "nMSE", "parameters", "runs", "time [s]")
    return Listing(f"{robot}, best first: {MEASURE}; medians of all runs", head, rows)


def _medians(runs: Sequence[RunResult], predictor: str, horizons: Sequence[str]) -> tuple[float, ...]:
    """Return the median error of each horizon, then of torques."""
    medians = []
    for horizon in (*horizons, None):
        errors = []
        for run in runs:
            judged = run["torque"] if horizon is None else run["errors"][horizon]
            error = judged.get(predictor)
            # an error that is not finite counts as infinitely bad
            errors.append(math.inf if error is None else error)
        medians.append(statistics.median(errors))
    return tuple(medians)


def _common(lists: Sequence[Iterable[str]]) -> list[str]:
    """Return the names that are in all lists, once, in the order of the first."""
    names = dict.fromkeys(lists[0]) if lists else {}
    common = set(names).intersection(*lists)
    return [name for name in names if name in common]


def _by_robot(fleet: FleetResults) -> dict[str, list[RunResult]]:
    robots: dict[str, list[RunResult]] = {}
    for run in fleet.results:
        robots.setdefault(run["robot"], []).append(run)
    return robots
