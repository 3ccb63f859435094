"""A comparison as tables: medians over seeds, next to published figures."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence

from spelgen.comparison.results import RunResult
from spelgen.evaluation.tables import Cell, Row, Table, known, table
from spelgen.listing import number
from spelgen.settings.comparison import PublishedFigures

BASELINE = "phnode"
Runs = Mapping[str, Sequence[RunResult]]
"""By variant, those of all seeds."""
Published = Mapping[str, PublishedFigures]
Quantity = Callable[[RunResult], float | None]

LOSSES: dict[str, Quantity] = {
    "training loss": lambda run: run.train.loss,
    "test loss": lambda run: run.test.loss,
    "prediction loss, 1 s": lambda run: run.prediction.loss,
    "velocity, 1 s": lambda run: run.prediction.velocity,
    "position, 1 s": lambda run: run.prediction.position,
    "M, relative error": lambda run: run.mass.error,
}
RATIOS = {"prediction loss, 1 s": "prediction loss", "velocity, 1 s": "velocity"}
"""Of these the baseline's is told by that of each variant."""
PUBLISHED = {
    "training loss": "train_loss",
    "test loss": "test_loss",
    "prediction loss": "prediction_loss",
    "velocity": "velocity",
    "position": "position",
}
"""By label, fields of `PublishedFigures`."""
INVARIANTS: dict[str, tuple[Quantity, Callable[[list[float]], float]]] = {
    "least eigenvalue of M / mean": (lambda run: run.invariants.least_eigenvalue, min),
    "rise of energy, no input": (lambda run: run.invariants.energy_rise, max),
    "energy drift, no friction": (lambda run: run.invariants.energy_drift, max),
}
"""By label, what is measured, and which of several is the worst."""


def comparison_tables(
    results: Sequence[RunResult], step_seconds: Mapping[str, float], published: Published
) -> list[Table]:
    """Return the tables of a comparison: sizes and speed, losses, those of each seed, invariants."""
    runs: dict[str, list[RunResult]] = {}
    for result in results:
        runs.setdefault(result.variant, []).append(result)
    return [
        _sizes(runs, step_seconds, published),
        _losses(runs, published),
        _by_seed(runs),
        _invariants(runs),
    ]


def _sizes(runs: Runs, step_seconds: Mapping[str, float], published: Published) -> Table:
    sizes = {name: of_seeds[0].sizes for name, of_seeds in runs.items()}
    rows = []
    for k, matrix in enumerate("MDGV"):
        cells = [Cell(str(size.outputs[k])) for size in sizes.values()]
        rows.append(Row(f"outputs of {matrix}", tuple(cells)))
    rows.append(Row("inputs of M", tuple(Cell(str(size.inputs)) for size in sizes.values())))
    rows.append(_row("parameters", {name: size.parameters for name, size in sizes.items()}, "{:,.0f}"))
    rows.append(_row("training step [ms]", {name: 1e3 * step_seconds[name] for name in runs}, "{:.1f}"))
    rows += _published(runs, published, "parameters", "parameters", "{:,.0f}")
    rows += _published(runs, published, "training step [s]", "step_seconds", "{:.2f}")
    title = "Sizes, and the time of a training step here; below, what is published"
    return Table(title, tuple(runs), tuple(rows))


def _losses(runs: Runs, published: Published) -> Table:
    rows = []
    for label, quantity in LOSSES.items():
        medians = {name: _median(of_seeds, quantity) for name, of_seeds in runs.items()}
        rows.append(_row(label, medians))
        if BASELINE in runs and label in RATIOS:
            ratios = tuple(_ratio(medians[BASELINE], median) for median in medians.values())
            rows.append(Row(f"{BASELINE}'s {RATIOS[label]} / this", ratios))
    for label, field in PUBLISHED.items():
        rows += _published(runs, published, label, field)
    title = (
        "Squared errors summed over joints [rad, m, s], mean over samples and windows, and the error of M, "
        "relative to M; median over seeds; below, what is published"
    )
    return Table(title, tuple(runs), tuple(rows))


def _by_seed(runs: Runs) -> Table:
    losses: dict[int, dict[str, float | None]] = {}
    for name, of_seeds in runs.items():
        for run in of_seeds:
            losses.setdefault(run.seed, {})[name] = run.prediction.loss
    labels = [f"seed {seed}" for seed in sorted(losses)]
    return table("Prediction loss over 1 s of every run", labels, [losses[seed] for seed in sorted(losses)])


def _invariants(runs: Runs) -> Table:
    rows = []
    for label, (quantity, worst) in INVARIANTS.items():
        cells = []
        for of_seeds in runs.values():
            values = known(map(quantity, of_seeds))
            all_finite = len(values) == len(of_seeds)
            cells.append(Cell(number(worst(values) if all_finite else None)))
        rows.append(Row(label, tuple(cells)))
    return Table("Invariants, worst over seeds; a negative rise is a fall", tuple(runs), tuple(rows))


def _ratio(baseline: float | None, median: float | None) -> Cell:
    """How many times worse than this variant the baseline predicts."""
    if baseline is None or not median:
        return Cell("-")
    return Cell(f"{baseline / median:.3g}")


def _median(runs: Sequence[RunResult], quantity: Quantity) -> float | None:
    """Return that over seeds; a run that is not finite counts as infinitely bad."""
    values = []
    for run in runs:
        value = quantity(run)
        # infinite and not left out: a variant that blows up in one seed of two is no better than the other seed
        values.append(math.inf if value is None else value)
    middle = statistics.median(values)
    return middle if math.isfinite(middle) else None


def _row(label: str, values: Mapping[str, float | None], form: str | None = None) -> Row:
    """Return a row of numbers, the least marked."""
    (row,) = table("", [label], [values]).rows
    if form is None:
        return row
    cells = []
    for value, cell in zip(values.values(), row.cells, strict=True):
        cells.append(Cell(form.format(value), cell.best))
    return Row(label, tuple(cells))


def _published(
    runs: Runs, published: Published, label: str, field: str, form: str | None = None
) -> list[Row]:
    """Return a row of published figures, or none where there are none for this robot."""
    texts = []
    for name in runs:
        value = getattr(published[name], field) if name in published else None
        if value is None:
            texts.append("")
        elif form is None:
            texts.append(number(value))
        else:
            texts.append(form.format(value))
    if not any(texts):
        return []
    return [Row(f"published: {label}", tuple(map(Cell, texts)))]
