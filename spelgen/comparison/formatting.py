"""A comparison as tables: medians over seeds, next to published figures."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence

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
    "M, relative error": lambda run: run.mass_error,
}
RATIOS = {"prediction loss, 1 s": "prediction loss", "velocity, 1 s": "velocity"}
"""Of these the baseline's is told by that of each variant."""
PUBLISHED = {
    "parameters": "parameters",
    "training step [s]": "step_seconds",
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
    for result in results:
        runs.setdefault(result.variant, []).append(result)
    for result in sorted(results, key=lambda result: result.seed):
        losses.setdefault(f"seed {result.seed}", {})[result.variant] = result.prediction.loss
    eigenvalue = _summary(runs, lambda x: x.invariants.least_eigenvalue, min)
    rise = _summary(runs, lambda x: x.invariants.energy_rise, max)
    invariants = (
        Row("least eigenvalue of M / mean", eigenvalue, ranked=False),
        Row("rise of energy, no input", rise, ranked=False),
    )
    return [
        _sizes(runs, step_seconds),
        _losses(runs, published),
        table("Prediction loss over 1 s of every run", losses),
        Table("Invariants, worst over seeds; a negative rise is a fall", invariants),
    ]


def _sizes(runs: Runs, step_seconds: Mapping[str, float]) -> Table:
    sizes = {name: of_seeds[0].sizes for name, of_seeds in runs.items()}
    rows = []
    for k, matrix in enumerate("MDGV"):
        outputs = {name: size.outputs[k] for name, size in sizes.items()}
        rows.append(Row(f"outputs of {matrix}", outputs, ranked=False))
    rows += [
        Row("inputs of M", {name: size.inputs for name, size in sizes.items()}, ranked=False),
        Row("parameters", {name: size.parameters for name, size in sizes.items()}),
        Row("training step [ms]", {name: 1e3 * step_seconds[name] for name in runs}),
    ]
    return Table("Sizes, and the time of a training step", tuple(rows))


def _losses(runs: Runs, published: Published) -> Table:
    rows = []
    for label, quantity in LOSSES.items():
        medians = _summary(runs, quantity, statistics.median)
        rows.append(Row(label, medians))
        baseline = medians.get(BASELINE)
        if baseline is not None and label in RATIOS:
            ratios = {name: baseline / median if median else None for name, median in medians.items()}
            rows.append(Row(f"{BASELINE}'s {RATIOS[label]} / this", ratios, ranked=False))
    for label, field in PUBLISHED.items():
        figures = {name: getattr(published[name], field) for name in runs if name in published}
        figures = {name: figure for name, figure in figures.items() if figure is not None}
        if figures:
            rows.append(Row(f"published: {label}", figures, ranked=False))
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
        values = list(map(quantity, of_seeds))
        # infinite and not left out: a variant that blows up in one seed of two is no better than the other seed
        summary = combined([math.inf if value is None else value for value in values])
        summaries[name] = summary if math.isfinite(summary) else None
    return summaries
