"""What a fleet found, as tables: models ranked for each arm, what a search chose, how units differ."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from spelgen.evaluation.names import MODEL
from spelgen.fleet.fleet import FleetResults
from spelgen.fleet.units import Quantity, Units
from spelgen.listing import Listing, number

Result = Mapping[str, Any]
BETTER = "relative RMS after each time (0: no error, 1: as if the arm had stood still), nMSE of torques"


def fleet_listings(found: FleetResults) -> list[Listing]:
    """All tables of a fleet's report."""
    robots = dict.fromkeys(result["robot"] for result in found.results)
    tables = [ranking(robot, [x for x in found.results if x["robot"] == robot]) for robot in robots]
    tables += [_searches(found)] if found.found else []
    tables += [_unit_listing(units, each) for units in found.units for each in units.quantities]
    tables += [_failures(found)] if found.failures else []
    return tables


def ranking(robot: str, results: Sequence[Result]) -> Listing:
    """One arm's models, the one that predicts best over the longest horizon first, and the baselines among them;
    medians over seeds and splits.
    """
    presets: dict[str, list[Result]] = {}
    for result in results:
        presets.setdefault(result["preset"], []).append(result)
    horizons = _common([list(result["errors"]) for result in results])
    baselines = _common([list(_baselines(result)) for result in results])
    lines = [_line(name, runs, MODEL, horizons) for name, runs in presets.items()]
    lines += [_line(f"({name})", results, name, horizons) for name in baselines]
    rows = tuple(
        (x.name, *map(_text, (*x.errors, x.torque, x.parameters, x.runs, x.seconds)))
        for x in sorted(lines, key=lambda line: line.order)
    )
    head = ("", *horizons, "nMSE", "parameters", "runs", "time [s]")
    return Listing(f"{robot}, best first: {BETTER}; medians of all runs", head, rows)


def winners(found: FleetResults) -> dict[str, int]:
    """Of how many arms each model is the best."""
    wins: dict[str, int] = {}
    for robot in dict.fromkeys(result["robot"] for result in found.results):
        rows = ranking(robot, [x for x in found.results if x["robot"] == robot]).rows
        best = next(name for name, *_ in rows if not name.startswith("("))
        wins[best] = wins.get(best, 0) + 1
    return dict(sorted(wins.items(), key=lambda each: -each[1]))


@dataclass(frozen=True)
class _Line:
    """A model or a baseline: errors by horizon, nMSE of torques; parameters, runs and their seconds of models alone."""

    name: str
    errors: tuple[float | None, ...]
    torque: float | None
    parameters: int | None = None
    runs: int | None = None
    seconds: float | None = None

    @property
    def order(self) -> list[float]:
        """By the error over the longest horizon, then by shorter ones, then by torque."""
        return [math.inf if x is None else x for x in (*reversed(self.errors), self.torque)]


def _line(name: str, runs: Sequence[Result], predictor: str, horizons: Sequence[str]) -> _Line:
    errors = tuple(_median([run["errors"][horizon].get(predictor) for run in runs]) for horizon in horizons)
    torque = _median([run["torque"].get(predictor) for run in runs])
    if predictor != MODEL:
        return _Line(name, errors, torque)
    seconds = _median([run["seconds"] for run in runs])
    return _Line(name, errors, torque, runs[0]["parameters"], len(runs), seconds)


def _median(values: Sequence[float | None]) -> float | None:
    """What is not finite counts as infinitely bad; None where that is the median."""
    middle = statistics.median(math.inf if x is None else x for x in values)
    return middle if math.isfinite(middle) else None


def _baselines(result: Result) -> dict[str, None]:
    """Names of all predictors but the model that are there at every horizon."""
    of_states = _common([list(errors) for errors in result["errors"].values()] or [[]])
    return dict.fromkeys(name for name in [*of_states, *result["torque"]] if name != MODEL)


def _common(lists: Sequence[Sequence[str]]) -> list[str]:
    first, *rest = lists
    return [name for name in first if all(name in other for other in rest)]


def _text(value: float | None) -> str:
    if isinstance(value, int):
        return f"{value:,}"
    return number(value)


def _searches(found: FleetResults) -> Listing:
    rows = tuple(
        (
            f"{robot}, {preset}",
            ", ".join(f"{k} {_text(x)}" for k, x in each.options.items()),
            number(each.loss),
            str(each.trials),
        )
        for (robot, preset), each in found.found.items()
    )
    return Listing(
        "What the search chose, by validation loss", ("", "options", "loss", "trials"), rows, left=(0, 1)
    )


def _unit_listing(units: Units, quantity: Quantity) -> Listing:
    """A row for each joint or parameter; a column for each unit, in order of their days."""
    titles = [
        name if day is None else f"{name} {day}" for name, day in zip(units.names, units.days, strict=True)
    ]
    rows = tuple(
        (
            label,
            *(number(unit[k]) for unit in quantity.values),
            number(quantity.common[k]),
            number(quantity.spread[k]),
        )
        for k, label in enumerate(quantity.labels)
    )
    title = f"{units.arm}: {quantity.name} [{quantity.unit}] of {len(units.names)} units or days"
    return Listing(title, ("", *titles, "all", "spread"), rows)


def _failures(found: FleetResults) -> Listing:
    rows = tuple((f"{name}: {why}",) for name, why in found.failures.items())
    return Listing("What failed; started again, it is tried again", ("",), rows)
