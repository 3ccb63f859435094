"""Tables and sentences of a comparison: medians over seeds and splits, next to published figures."""

import math
import statistics
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from spelgen.comparison.figures import Figures
from spelgen.comparison.jobs import RunResult
from spelgen.comparison.study import Study
from spelgen.evaluation.tables import Row, Table
from spelgen.labels import MODEL, counted, listed
from spelgen.listing import number
from spelgen.settings.training import PublishedFigures

BASELINE = "phnode"
Runs = Mapping[str, Sequence[RunResult]]
"""Preset -> results of the runs of an arm with all seeds and splits."""
Numbers = dict[str, float | None]
RATIO = {"prediction loss, 1 s": "prediction loss", "velocity, 1 s": "velocity"}
"""{label of a row of losses: name of this loss in the label of the row below}.

The row below contains the loss of the baseline (`BASELINE`) divided by the loss of each model.
"""


@dataclass(frozen=True)
class ArmResults:
    """The results of one arm: the preset with the smallest error, and tables (the main result first).

    sentence: text that compares the error of the best model with the errors of the other models.
    """

    name: str
    best: str
    sentence: str
    tables: tuple[Table, ...]


def arm_sections(study: Study) -> list[ArmResults]:
    """Return the tables of each arm with finished runs, and the sentence that names its best model, for a report."""
    arms: dict[str, list[RunResult]] = {}
    for job in study.jobs:
        if job.name in study.results:
            arms.setdefault(job.arm, []).append(study.results[job.name])
    published = {job.arm: job.protocol.published for job in study.jobs}
    sections = []
    for name, results in arms.items():
        runs, measure = _by_preset(results), _main_measure(results)
        # `_medians` sorts by error and contains baselines, which have no runs.
        best = next(model for model in _medians(runs, measure) if model in runs)
        tables = tuple(arm_tables(results, published[name]))
        sections.append(ArmResults(name, best, arm_sentence(results), tables))
    return sections


def arm_tables(results: Sequence[RunResult], published: Mapping[str, PublishedFigures]) -> list[Table]:
    """Return the tables of an arm, the main result first. published: {preset: figures of a publication}."""
    runs = _by_preset(results)
    figures = {name: [run.simulated for run in x if run.simulated] for name, x in runs.items()}
    # The true parameters of a user's arm are unknown, so the only table about such an arm has the errors on test logs.
    if not all(figures.values()):
        return [_ranking(runs)]
    rows = []
    sizes = {name: [run.sizes for run in x] for name, x in figures.items()}
    for label in next(iter(sizes.values()))[0]:
        worst = max if label == "rise of energy, no input" else min
        rows.append(Row(label, _summary(sizes, label, worst), label in ("parameters", "training step [ms]")))
    losses = {name: [run.losses for run in x] for name, x in figures.items()}
    title = (
        "Sizes, time of a training step, and invariants, the worst over seeds; a negative rise is a decrease"
    )
    return [_losses(losses, published), Table(title, tuple(rows))]


def arm_sentence(results: Sequence[RunResult]) -> str:
    """Return a sentence that names the best model of an arm and compares its error with the errors of all others."""
    runs, measure = _by_preset(results), _main_measure(results)
    errors = {name: error for name, error in _medians(runs, measure).items() if error is not None}
    models = [name for name in errors if name in runs]
    if not models:
        return f"No model has a finite {measure}."
    # `_medians` sorts by error, so the first model has the smallest error.
    best = errors[models[0]]
    # Models with errors equal to three digits are named together, for example closed-form and hybrid without residual
    # terms, which are the same model.
    equal = [name for name in models if number(errors[name]) == number(best)]
    sentence = f"{listed(equal)} {'have' if len(equal) > 1 else 'has'} the smallest {measure}: {number(best)}"
    smaller, larger = [], []
    for name, error in errors.items():
        if name not in equal and error < best:
            smaller.append(f"{name} ({number(error)})")
        # Ratios to the best error are omitted if the best error is zero.
        elif name not in equal and best:
            larger.append(f"{number(error / best)} times smaller than with {name}")
    if larger:
        sentence += f", {listed(larger)}"
    if smaller:
        sentence += f"; but these baselines have a smaller one: {listed(smaller)}"
    return f"{sentence}."


def comparison_sentence(sections: Sequence[ArmResults]) -> str:
    """Return one sentence about all arms: the number of arms on which each preset is best."""
    if not sections:
        return "No run is finished."
    if len(sections) == 1:
        return sections[0].sentence
    wins = Counter(section.best for section in sections)
    counts = [f"{name} on {counted(count, 'arm')}" for name, count in wins.most_common()]
    return f"The preset with the smallest error is {listed(counts)}."


def _main_measure(results: Sequence[RunResult]) -> str:
    """Return the first error measure of the runs, which ranks the models."""
    return next(iter(results[0].errors))


def _by_preset(results: Sequence[RunResult]) -> dict[str, list[RunResult]]:
    runs: dict[str, list[RunResult]] = {}
    for result in results:
        runs.setdefault(result.preset, []).append(result)
    return runs


def _ranking(runs: Runs) -> Table:
    """Return a table of the errors of models and baselines on logs of the user, sorted by error."""
    rows = [Row(measure, _medians(runs, measure)) for measure in next(iter(runs.values()))[0].errors]
    seconds = {name: statistics.median(run.seconds for run in x) for name, x in runs.items()}
    rows.append(Row("parameters", {name: x[0].parameters for name, x in runs.items()}, ranked=False))
    rows.append(Row("runs", {name: len(x) for name, x in runs.items()}, ranked=False))
    rows.append(Row("training time [s]", seconds, ranked=False))
    title = "Errors on the test logs, best first; medians over seeds and splits"
    note = "relative RMS: 0: no error, 1: as if the arm had stood still; columns without parameters are baselines"
    return Table(title, tuple(rows), note)


def _medians(runs: Runs, measure: str) -> Numbers:
    """Return {model or baseline: median error by ``measure``}, sorted by error; errors that are not finite are last."""
    values: dict[str, list[float | None]] = {}
    for preset, of_preset in runs.items():
        for run in of_preset:
            for predictor, error in run.errors.get(measure, {}).items():
                values.setdefault(preset if predictor == MODEL else predictor, []).append(error)
    medians = {name: _combined(errors, statistics.median) for name, errors in values.items()}
    return dict(sorted(medians.items(), key=lambda item: math.inf if item[1] is None else item[1]))


def _losses(figures: Mapping[str, Sequence[Figures]], published: Mapping[str, PublishedFigures]) -> Table:
    rows = []
    for label in next(iter(figures.values()))[0]:
        medians = _summary(figures, label, statistics.median)
        rows.append(Row(label, medians))
        baseline = medians.get(BASELINE)
        # A row with the loss of the preset `BASELINE` divided by each preset's loss is added, because absolute losses
        # depend on units and on the sample rate.
        if baseline is not None and label in RATIO:
            ratios = {name: baseline / median if median else None for name, median in medians.items()}
            rows.append(Row(f"{BASELINE}'s {RATIO[label]} / this", ratios, ranked=False))
    # Published figures are added as further rows. Presets that the publication does not evaluate have no number there.
    records = {name: published[name].model_dump(exclude_none=True) for name in figures if name in published}
    for field in PublishedFigures.model_fields:
        values = {name: record[field] for name, record in records.items() if field in record}
        if values:
            rows.append(Row(f"published: {field.replace('_', ' ')}", values, ranked=False))
    title = (
        "Squared errors summed over joints [rad, m, s], mean over samples and windows, and the relative error of M; "
        "median over seeds; below, published figures"
    )
    return Table(title, tuple(rows))


def _summary(
    figures: Mapping[str, Sequence[Figures]], label: str, combine: Callable[[list[float]], float]
) -> Numbers:
    """Return {preset: number}, the row `label` of a table.

    figures: {preset: figures of all runs}. combine: function that combines the figures of a preset's runs to one
    number, such as the median.
    """
    return {name: _combined([run[label] for run in runs], combine) for name, runs in figures.items()}


def _combined(values: Sequence[float | None], combine: Callable[[list[float]], float]) -> float | None:
    """Return combine(values), in which None is replaced by infinity; None if the result is not finite."""
    # None is not omitted: otherwise a model that diverges with one of two seeds would be ranked by the other seed.
    combined = combine([math.inf if value is None else value for value in values])
    return combined if math.isfinite(combined) else None
