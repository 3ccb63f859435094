"""What a comparison found, as tables: median over seeds, next to published figures."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from spelgen.evaluation.tables import Cell, Row, Table
from spelgen.listing import number
from spelgen.settings.comparison import PublishedFigures

BASELINE = "phnode"
Result = Mapping[str, Any]


def comparison_tables(
    results: Sequence[Result], step_seconds: Mapping[str, float], published: Mapping[str, PublishedFigures]
) -> list[Table]:
    """The tables of a comparison: sizes and speed, losses, those of each seed, invariants."""
    by_variant: dict[str, list[Result]] = {}
    for result in results:
        by_variant.setdefault(result["variant"], []).append(result)
    return [
        _sizes(by_variant, step_seconds, published),
        _losses(by_variant, published),
        _by_seed(by_variant),
        _invariants(by_variant),
    ]


def _sizes(
    found: Mapping[str, Sequence[Result]],
    step_seconds: Mapping[str, float],
    published: Mapping[str, PublishedFigures],
) -> Table:
    names = tuple(found)
    first = {name: runs[0]["sizes"] for name, runs in found.items()}
    rows = [
        Row(f"outputs of {what}", tuple(Cell(str(first[name]["outputs"][k])) for name in names))
        for k, what in enumerate("MDGV")
    ]
    rows.append(Row("inputs of M", tuple(Cell(str(first[name]["inputs"])) for name in names)))
    rows.append(_row("parameters", {name: first[name]["parameters"] for name in names}, "{:,.0f}"))
    milliseconds = {name: 1e3 * step_seconds[name] for name in names}
    rows.append(_row("training step [ms]", milliseconds, "{:.1f}"))
    rows += _published(names, published, "parameters", lambda each: each.parameters, "{:,.0f}")
    rows += _published(names, published, "training step [s]", lambda each: each.step_seconds, "{:.2f}")
    return Table("Sizes, and the time of a training step here; below, what is published", names, tuple(rows))


def _losses(found: Mapping[str, Sequence[Result]], published: Mapping[str, PublishedFigures]) -> Table:
    names = tuple(found)
    quantities: dict[str, tuple[str, str]] = {
        "training loss": ("train", "loss"),
        "test loss": ("test", "loss"),
        "prediction loss, 1 s": ("prediction", "loss"),
        "velocity, 1 s": ("prediction", "velocity"),
        "position, 1 s": ("prediction", "position"),
    }
    rows = [
        _row(label, {name: _median(found[name], *path) for name in names})
        for label, path in quantities.items()
    ]
    if BASELINE in found:
        rows.insert(3, Row(f"{BASELINE}'s prediction loss / this", _ratios(found, names, "loss")))
        rows.insert(5, Row(f"{BASELINE}'s velocity / this", _ratios(found, names, "velocity")))
    rows.append(_row("M, relative error", {name: _median(found[name], "mass", "error") for name in names}))
    rows += _published(names, published, "training loss", lambda each: each.train_loss)
    rows += _published(names, published, "test loss", lambda each: each.test_loss)
    rows += _published(names, published, "prediction loss", lambda each: each.prediction_loss)
    rows += _published(names, published, "velocity", lambda each: each.velocity)
    rows += _published(names, published, "position", lambda each: each.position)
    title = (
        "Squared errors summed over joints [rad, m, s], mean over samples and windows, and the error of M, "
        "relative to M; median over seeds; below, what is published"
    )
    return Table(title, names, tuple(rows))


def _by_seed(found: Mapping[str, Sequence[Result]]) -> Table:
    names = tuple(found)
    seeds = sorted({run["seed"] for runs in found.values() for run in runs})
    rows = []
    for seed in seeds:
        losses = {
            name: next((x["prediction"]["loss"] for x in found[name] if x["seed"] == seed), None)
            for name in names
        }
        rows.append(_row(f"seed {seed}", losses))
    return Table("Prediction loss over 1 s of every run", names, tuple(rows))


def _invariants(found: Mapping[str, Sequence[Result]]) -> Table:
    names = tuple(found)
    worst: dict[str, tuple[str, Callable[[list[float]], float]]] = {
        "least eigenvalue of M / mean": ("least_eigenvalue", min),
        "|R R^T - I|, 10,000 steps": ("orthogonality", max),
        "rise of energy, no input": ("energy_rise", max),
        "energy drift, no friction": ("energy_drift", max),
    }
    rows = []
    for label, (key, pick) in worst.items():
        values = {name: _worst([run["invariants"][key] for run in found[name]], pick) for name in names}
        rows.append(Row(label, tuple(Cell(number(values[name])) for name in names)))
    return Table("Invariants, worst over seeds; a negative rise is a fall", names, tuple(rows))


def _worst(values: Sequence[float | None], pick: Callable[[list[float]], float]) -> float | None:
    known = [value for value in values if value is not None]
    return pick(known) if len(known) == len(values) else None


def _ratios(found: Mapping[str, Sequence[Result]], names: Sequence[str], key: str) -> tuple[Cell, ...]:
    """How many times worse than each the baseline predicts."""
    base = _median(found[BASELINE], "prediction", key)
    cells = []
    for name in names:
        value = _median(found[name], "prediction", key)
        cells.append(Cell("-" if not value or base is None else f"{base / value:.3g}"))
    return tuple(cells)


def _median(runs: Sequence[Result], group: str, key: str) -> float | None:
    """Over the seeds; a run that is not finite counts as infinitely bad."""
    values = [run[group][key] if run[group][key] is not None else float("inf") for run in runs]
    middle = statistics.median(values)
    return None if middle == float("inf") else middle


def _row(label: str, values: Mapping[str, float | None], form: str | None = None) -> Row:
    known = [value for value in values.values() if value is not None]
    least = min(known) if len(known) > 1 else None
    cells = []
    for value in values.values():
        text = number(value) if form is None or value is None else form.format(value)
        cells.append(Cell(text, best=value is not None and value == least))
    return Row(label, tuple(cells))


def _published(
    names: Sequence[str],
    published: Mapping[str, PublishedFigures],
    label: str,
    of: Callable[[PublishedFigures], float | None],
    form: str | None = None,
) -> list[Row]:
    """A row of published figures, or none where there are none for this robot."""
    values = {name: of(published[name]) if name in published else None for name in names}
    if all(value is None for value in values.values()):
        return []
    cells = tuple(
        Cell("" if value is None else number(value) if form is None else form.format(value))
        for value in values.values()
    )
    return [Row(f"published: {label}", cells)]
