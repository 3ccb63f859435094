"""Tables and sentences of a comparison: medians over seeds and splits, next to published figures."""

import math
import statistics
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from spelgen.comparison.jobs import RunResult
from spelgen.comparison.study import Study
from spelgen.evaluation.tables import table
from spelgen.labels import MODEL, counted, listed
from spelgen.listing import Listing, number
from spelgen.settings.training import PublishedFigures

Runs = Mapping[str, Sequence[RunResult]]
"""Preset -> results of the runs of an arm with all seeds and splits."""
Numbers = dict[str, float | None]


@dataclass(frozen=True)
class ArmResults:
    """The results of one arm: the preset with the smallest error, and tables (the main result first).

    sentence: text that compares the error of the best model with the errors of the other models.
    """

    name: str
    best: str
    sentence: str
    tables: tuple[Listing, ...]


def arm_sections(study: Study) -> list[ArmResults]:
    """Return the tables of each arm with finished runs, and the sentence that names its best model, for a report."""
    arms: dict[str, list[RunResult]] = {}
    for job in study.jobs:
        if job.name in study.results:
            arms.setdefault(job.arm, []).append(study.results[job.name])
    published = {job.arm: job.protocol.published for job in study.jobs}
    return [arm_results(name, results, published[name]) for name, results in arms.items()]


def arm_results(
    name: str, results: Sequence[RunResult], published: Mapping[str, PublishedFigures]
) -> ArmResults:
    """Return the results of one arm. results: at least one run. published: {preset: figures of a publication}."""
    runs: dict[str, list[RunResult]] = {}
    for result in results:
        runs.setdefault(result.preset, []).append(result)
    medians = {measure: _medians(runs, measure) for measure in results[0].errors}
    measure, errors = next(iter(medians.items()))
    ranked = _by_error(errors)
    # `ranked` also contains baselines, which are not trained: the best model is the first one with runs.
    best = next(model for model in ranked if model in runs)
    # The true parameters of a user's arm are unknown, so the only table about such an arm has the errors on test logs.
    tables = (_losses(medians, published), _sizes(runs)) if results[0].sizes else (_ranking(medians, runs),)
    return ArmResults(name, best, _sentence(measure, ranked, runs), tables)


def _sentence(measure: str, ranked: Numbers, runs: Runs) -> str:
    """Return a sentence that names the best model of an arm and compares its error with the errors of all others.

    ranked: errors of models and baselines by ``measure``, the smallest one first.
    """
    errors = {name: error for name, error in ranked.items() if error is not None}
    models = [name for name in errors if name in runs]
    if not models:
        return f"No model has a finite {measure}."
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


def _ranking(medians: Mapping[str, Numbers], runs: Runs) -> Listing:
    """Return a table of the errors of models and baselines on logs of the user, sorted by error.

    medians: {measure: median errors}.
    """
    rows = {measure: _by_error(errors) for measure, errors in medians.items()}
    rows["parameters"] = {name: x[0].parameters for name, x in runs.items()}
    rows["runs"] = {name: len(x) for name, x in runs.items()}
    rows["training time [s]"] = {
        name: statistics.median(run.seconds for run in x) for name, x in runs.items()
    }
    title = "Errors on the test logs, best first; medians over seeds and splits"
    note = "relative RMS: 0: no error, 1: as if the arm had stood still; columns without parameters are baselines"
    return table(title, rows, note, unranked=rows.keys() - medians)


def _medians(runs: Runs, measure: str) -> Numbers:
    """Return {model or baseline: median error over seeds and splits}; None for an error that is not finite."""
    values: dict[str, list[float | None]] = {}
    for preset, of_preset in runs.items():
        for run in of_preset:
            for predictor, error in run.errors.get(measure, {}).items():
                values.setdefault(preset if predictor == MODEL else predictor, []).append(error)
    return {name: _combined(errors, statistics.median) for name, errors in values.items()}


def _by_error(medians: Numbers) -> Numbers:
    """Return the median errors, {model or baseline: error}, in ascending order; errors that are None are last."""
    return dict(sorted(medians.items(), key=lambda item: math.inf if item[1] is None else item[1]))


def _losses(medians: Mapping[str, Numbers], published: Mapping[str, PublishedFigures]) -> Listing:
    """Return the table of the losses of the models of a simulated arm, their errors of M, and published figures.

    The losses are squared prediction errors on training and test logs. medians: {measure: {preset: median}}. published:
    {preset: figures of a publication}.
    """
    rows, presets = dict(medians), next(iter(medians.values()))
    # Published figures are added as further rows. The cell of a preset that the publication does not evaluate is empty.
    records = {name: published[name].model_dump(exclude_none=True) for name in presets if name in published}
    for field in PublishedFigures.model_fields:
        values = {name: record[field] for name, record in records.items() if field in record}
        if values:
            rows[f"published: {field.replace('_', ' ')}"] = values
    title = (
        "Squared errors summed over joints [rad, m, s], mean over samples and windows, and the relative error of M; "
        "median over seeds; below, published figures"
    )
    return table(title, rows, unranked=rows.keys() - medians)


def _sizes(runs: Runs) -> Listing:
    """Return a table of the numbers of outputs, inputs and parameters of models, and of the time of a training step."""
    rows = {}
    for label in next(iter(runs.values()))[0].sizes:
        rows[label] = {name: _combined([run.sizes[label] for run in x], min) for name, x in runs.items()}
    ranked = ("parameters", "training step [ms]")
    return table("Sizes, and time of a training step", rows, unranked=rows.keys() - ranked)


def _combined(values: Sequence[float | None], combine: Callable[[list[float]], float]) -> float | None:
    """Return combine(values), in which None is replaced by infinity; None if the result is not finite."""
    # None, the error of a diverged run, counts as infinite: if it were omitted, a model that diverges with one of two
    # seeds would be ranked by the other seed only.
    combined = combine([math.inf if value is None else value for value in values])
    return combined if math.isfinite(combined) else None
