"""A comparison as tables: medians over seeds, next to published figures."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from spelgen.comparison.metrics import RunResult
from spelgen.evaluation.tables import Row, Table, table
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


def comparison_tables(
    results: Sequence[RunResult], step_seconds: Mapping[str, float], published: Published
) -> list[Table]:
    """Return the tables of a comparison: sizes and speed, losses, those of each seed, invariants."""
    runs: dict[str, list[RunResult]] = {}
    losses: dict[str, dict[str, float | None]] = {}
    for result in sorted(results, key=lambda result: result.seed):
        losses.setdefault(f"seed {result.seed}", {})[result.variant] = result.prediction.loss
    for result in results:
        runs.setdefault(result.variant, []).append(result)
    invariants = (
        Row("least eigenvalue of M / mean", _summary(runs, lambda x: x.invariants.least_eigenvalue, min)),
        Row("rise of energy, no input", _summary(runs, lambda x: x.invariants.energy_rise, max)),
    )
    return [
        _sizes(runs, step_seconds, published),
        _losses(runs, published),
        table("Prediction loss over 1 s of every run", losses),
        Table(
            "Invariants, worst over seeds; a negative rise is a fall",
            tuple(replace(row, ranked=False) for row in invariants),
        ),
    ]


def _sizes(runs: Runs, step_seconds: Mapping[str, float], published: Published) -> Table:
    sizes = {name: of_seeds[0].sizes for name, of_seeds in runs.items()}
    rows = []
    for k, matrix in enumerate("MDGV"):
        outputs = {name: size.outputs[k] for name, size in sizes.items()}
        rows.append(Row(f"outputs of {matrix}", outputs, ranked=False))
    rows += [
        Row("inputs of M", {name: size.inputs for name, size in sizes.items()}, ranked=False),
        Row("parameters", {name: size.parameters for name, size in sizes.items()}),
        Row("training step [ms]", {name: 1e3 * step_seconds[name] for name in runs}),
        *_published(runs, published, "parameters", "parameters"),
        *_published(runs, published, "training step [s]", "step_seconds"),
    ]
    return Table("Sizes, and the time of a training step here; below, what is published", tuple(rows))


def _losses(runs: Runs, published: Published) -> Table:
    rows = []
    for label, quantity in LOSSES.items():
        medians = _summary(runs, quantity, statistics.median)
        rows.append(Row(label, medians))
        baseline = medians.get(BASELINE)
        if BASELINE in runs and label in RATIOS:
            ratios: dict[str, float | None] = dict.fromkeys(medians)
            for name, median in medians.items():
                if baseline is not None and median:
                    ratios[name] = baseline / median
            rows.append(Row(f"{BASELINE}'s {RATIOS[label]} / this", ratios, ranked=False))
    for label, field in PUBLISHED.items():
        rows += _published(runs, published, label, field)
    title = (
        "Squared errors summed over joints [rad, m, s], mean over samples and windows, and the error of M, "
        "relative to M; median over seeds; below, what is published"
    )
    return Table(title, tuple(rows))


def _summary(
    runs: Runs, quantity: Quantity, combined: Callable[[list[float]], float]
) -> dict[str, float | None]:
    """Return by variant one number of all seeds; a run that is not finite counts as infinitely bad."""
    summaries: dict[str, float | None] = {}
    for name, of_seeds in runs.items():
        values = []
        for run in of_seeds:
            value = quantity(run)
            # infinite and not left out: a variant that blows up in one seed of two is no better than the other seed
            values.append(math.inf if value is None else value)
        summary = combined(values)
        summaries[name] = summary if math.isfinite(summary) else None
    return summaries


def _published(runs: Runs, published: Published, label: str, field: str) -> list[Row]:
    """Return a row of published figures, or none where there are none for this robot."""
    figures = {name: getattr(published[name], field) for name in runs if name in published}
    figures = {name: figure for name, figure in figures.items() if figure is not None}
    return [Row(f"published: {label}", figures, ranked=False)] if figures else []
