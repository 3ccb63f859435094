"""A comparison as tables: medians over seeds, next to published figures."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence

from spelgen.comparison.results import RunResult
from spelgen.evaluation.tables import Numbers, Row, Table, known, table
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
        outputs = {name: size.outputs[k] for name, size in sizes.items()}
        rows.append(Row(f"outputs of {matrix}", outputs, ranked=False))
    rows += [
        Row("inputs of M", {name: size.inputs for name, size in sizes.items()}, ranked=False),
        Row("parameters", {name: size.parameters for name, size in sizes.items()}, "{:,.0f}".format),
        Row("training step [ms]", {name: 1e3 * step_seconds[name] for name in runs}, "{:.1f}".format),
        *_published(runs, published, "parameters", "parameters", "{:,.0f}".format),
        *_published(runs, published, "training step [s]", "step_seconds", "{:.2f}".format),
    ]
    return Table("Sizes, and the time of a training step here; below, what is published", tuple(rows))


def _losses(runs: Runs, published: Published) -> Table:
    rows = []
    for label, quantity in LOSSES.items():
        medians = {name: _median(of_seeds, quantity) for name, of_seeds in runs.items()}
        rows.append(Row(label, medians))
        if BASELINE in runs and label in RATIOS:
            rows.append(Row(f"{BASELINE}'s {RATIOS[label]} / this", _ratios(medians), ranked=False))
    for label, field in PUBLISHED.items():
        rows += _published(runs, published, label, field)
    title = (
        "Squared errors summed over joints [rad, m, s], mean over samples and windows, and the error of M, "
        "relative to M; median over seeds; below, what is published"
    )
    return Table(title, tuple(rows))


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
        worst_values: dict[str, float | None] = {}
        for name, of_seeds in runs.items():
            values = known(map(quantity, of_seeds))
            worst_values[name] = worst(values) if len(values) == len(of_seeds) else None
        rows.append(Row(label, worst_values, ranked=False))
    return Table("Invariants, worst over seeds; a negative rise is a fall", tuple(rows))


def _ratios(medians: Numbers) -> Numbers:
    """Return how many times worse than each variant the baseline predicts."""
    baseline = medians[BASELINE]
    ratios: dict[str, float | None] = dict.fromkeys(medians)
    for name, median in medians.items():
        if baseline is not None and median:
            ratios[name] = baseline / median
    return ratios


def _median(runs: Sequence[RunResult], quantity: Quantity) -> float | None:
    """Return that over seeds; a run that is not finite counts as infinitely bad."""
    values = []
    for run in runs:
        value = quantity(run)
        # infinite and not left out: a variant that blows up in one seed of two is no better than the other seed
        values.append(math.inf if value is None else value)
    middle = statistics.median(values)
    return middle if math.isfinite(middle) else None


def _published(
    runs: Runs, published: Published, label: str, field: str, form: Callable[[float | None], str] = number
) -> list[Row]:
    """Return a row of published figures, or none where there are none for this robot."""
    figures = {name: getattr(published[name], field) for name in runs if name in published}
    figures = {name: figure for name, figure in figures.items() if figure is not None}
    return [Row(f"published: {label}", figures, form, ranked=False)] if figures else []
