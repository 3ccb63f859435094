"""Tables and sentences of a comparison: medians over seeds and splits, beside published figures."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from spelgen.baselines.names import MODEL
from spelgen.comparison.figures import SimulatedFigures
from spelgen.comparison.jobs import RunResult
from spelgen.comparison.study import Study
from spelgen.evaluation.tables import Row, Table, table
from spelgen.labels import counted, listed
from spelgen.listing import number
from spelgen.settings.comparison import PublishedFigures

BASELINE = "phnode"
Runs = Mapping[str, Sequence[RunResult]]
"""Runs of all seeds and splits of an arm, by preset."""
Numbers = dict[str, float | None]

LOSSES: dict[str, Callable[[SimulatedFigures], float | None]] = {
    "prediction loss, 1 s": lambda run: run.prediction.loss,
    "velocity, 1 s": lambda run: run.prediction.velocity,
    "position, 1 s": lambda run: run.prediction.position,
    "M, relative error": lambda run: run.mass_error,
    "training loss": lambda run: run.train.loss,
    "test loss": lambda run: run.test.loss,
}
RATIOS = {"prediction loss, 1 s": "prediction loss", "velocity, 1 s": "velocity"}
"""Rows that are followed by the baseline's figure divided by the figure of each model."""
PUBLISHED: dict[str, Callable[[PublishedFigures], float | None]] = {
    "prediction loss": lambda figures: figures.prediction_loss,
    "velocity": lambda figures: figures.velocity,
    "position": lambda figures: figures.position,
    "training loss": lambda figures: figures.train_loss,
    "test loss": lambda figures: figures.test_loss,
    "parameters": lambda figures: figures.parameters,
    "training step [s]": lambda figures: figures.step_seconds,
}


@dataclass(frozen=True)
class ArmSection:
    """The results of one arm: a sentence, tables of which the first shows the result, and the results themselves."""

    name: str
    sentence: str
    tables: tuple[Table, ...]
    results: tuple[RunResult, ...]


def arm_sections(study: Study) -> list[ArmSection]:
    """Return a section for each arm with finished runs."""
    sections = []
    for name, results in study.arms.items():
        published = next(job.protocol.published for job in study.jobs if job.arm == name)
        tables = arm_tables(results, study.step_seconds.get(name, {}), published)
        sections.append(ArmSection(name, arm_sentence(results), tuple(tables), tuple(results)))
    return sections


def arm_tables(
    results: Sequence[RunResult],
    step_seconds: Mapping[str, float],
    published: Mapping[str, PublishedFigures],
) -> list[Table]:
    """Return the tables of an arm, the one with the result first.

    step_seconds: time of a training step [s], by preset. published: figures of a publication, by preset.
    """
    runs = _by_preset(results)
    if results[0].simulated is None:
        return [_ranking(runs)]
    losses: dict[str, Numbers] = {}
    for result in sorted(results, key=lambda result: (result.seed, result.split)):
        split = f", split {result.split}" if any(x.split for x in results) else ""
        loss = next(iter(result.errors.values()))[MODEL]
        losses.setdefault(f"seed {result.seed}{split}", {})[result.preset] = loss
    eigenvalue = _summary(runs, lambda run: run.invariants.least_eigenvalue, min)
    rise = _summary(runs, lambda run: run.invariants.energy_rise, max)
    invariants = (
        Row("smallest eigenvalue of M / mean", eigenvalue, ranked=False),
        Row("rise of energy, no input", rise, ranked=False),
    )
    return [
        _losses(runs, published),
        _sizes(runs, step_seconds),
        table("Prediction loss over 1 s of every run", losses),
        Table("Invariants, worst over seeds; a negative rise is a decrease", invariants),
    ]


def arm_sentence(results: Sequence[RunResult]) -> str:
    """Return one sentence: the best model of an arm, and by which factor its error is smaller than those of others."""
    runs, measure = _by_preset(results), next(iter(results[0].errors))
    errors = {name: error for name, error in _medians(runs, measure).items() if error is not None}
    models = [name for name in errors if name in runs]
    if not models:
        return f"No model has a finite {measure}."
    best = errors[models[0]]
    # equal to three digits: in effect the same model, as closed-form and hybrid without residual terms
    equal = [name for name in models if number(errors[name]) == number(best)]
    sentence = f"{listed(equal)} {'have' if len(equal) > 1 else 'has'} the smallest {measure}: {number(best)}"
    smaller, larger = [], []
    for name, error in errors.items():
        if name not in equal and error < best:
            smaller.append(f"{name} ({number(error)})")
        elif name not in equal and best:
            larger.append(f"{number(error / best)} times smaller than with {name}")
    if larger:
        sentence += f", {listed(larger)}"
    if smaller:
        sentence += f"; but these baselines have a smaller one: {listed(smaller)}"
    return f"{sentence}."


def comparison_sentence(sections: Sequence[ArmSection]) -> str:
    """Return one sentence about all arms: the number of arms on which each preset is best."""
    if not sections:
        return "No run is finished."
    if len(sections) == 1:
        return sections[0].sentence
    wins: dict[str, int] = {}
    for section in sections:
        runs, measure = _by_preset(section.results), next(iter(section.results[0].errors))
        best = next(name for name in _medians(runs, measure) if name in runs)
        wins[best] = wins.get(best, 0) + 1
    best_first = sorted(wins.items(), key=lambda item: -item[1])
    counts = [f"{name} on {counted(count, 'arm')}" for name, count in best_first]
    return f"The preset with the smallest error is {listed(counts)}."


def _by_preset(results: Sequence[RunResult]) -> dict[str, list[RunResult]]:
    runs: dict[str, list[RunResult]] = {}
    for result in results:
        runs.setdefault(result.preset, []).append(result)
    return runs


def _ranking(runs: Runs) -> Table:
    """Return the errors of models and baselines on the user's logs, the best one first."""
    every = [run for of_preset in runs.values() for run in of_preset]
    measures = [name for name in every[0].errors if all(name in run.errors for run in every)]
    rows = [Row(measure, _medians(runs, measure)) for measure in measures]
    count = {name: len(of_preset) for name, of_preset in runs.items()}
    parameters = {name: of_preset[0].parameters for name, of_preset in runs.items()}
    seconds = {name: statistics.median(run.seconds for run in of_preset) for name, of_preset in runs.items()}
    rows += [
        Row("parameters", parameters, ranked=False),
        Row("runs", count, ranked=False),
        Row("training time [s]", seconds, ranked=False),
    ]
    title = "Errors on the test logs, best first; medians over seeds and splits"
    note = "relative RMS: 0 is no error, 1 the error if the arm had stood still; columns without parameters are baselines"
    return Table(title, tuple(rows), note)


def _medians(runs: Runs, measure: str) -> Numbers:
    """Return the median error of each model and baseline, the smallest first; an error that is not finite is last."""
    values: dict[str, list[float]] = {}
    for preset, of_preset in runs.items():
        for run in of_preset:
            for predictor, error in run.errors[measure].items():
                name = preset if predictor == MODEL else predictor
                # infinite and not left out: a model that diverges with one seed of two must not rank by the other
                values.setdefault(name, []).append(math.inf if error is None else error)
    medians = {name: statistics.median(errors) for name, errors in values.items()}
    ordered = sorted(medians.items(), key=lambda item: item[1])
    return {name: median if math.isfinite(median) else None for name, median in ordered}


def _sizes(runs: Runs, step_seconds: Mapping[str, float]) -> Table:
    sizes = {name: run.simulated.sizes for name, (run, *_) in runs.items() if run.simulated}
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


def _losses(runs: Runs, published: Mapping[str, PublishedFigures]) -> Table:
    rows = []
    for label, figure in LOSSES.items():
        medians = _summary(runs, figure, statistics.median)
        rows.append(Row(label, medians))
        baseline = medians.get(BASELINE)
        if baseline is not None and label in RATIOS:
            ratios = {name: baseline / median if median else None for name, median in medians.items()}
            rows.append(Row(f"{BASELINE}'s {RATIOS[label]} / this", ratios, ranked=False))
    for label, publication in PUBLISHED.items():
        of_models = {name: publication(published[name]) for name in runs if name in published}
        figures = {name: value for name, value in of_models.items() if value is not None}
        if figures:
            rows.append(Row(f"published: {label}", figures, ranked=False))
    title = (
        "Squared errors summed over joints [rad, m, s], mean over samples and windows, and the relative error of M; "
        "median over seeds; below, published figures"
    )
    return Table(title, tuple(rows))


def _summary(
    runs: Runs,
    figure: Callable[[SimulatedFigures], float | None],
    combined: Callable[[list[float]], float],
) -> Numbers:
    """Return one number per preset for all runs; a run whose figure is not finite counts as infinitely bad."""
    summaries: Numbers = {}
    for name, of_preset in runs.items():
        values = [figure(run.simulated) for run in of_preset if run.simulated]
        summary = combined([math.inf if value is None else value for value in values])
        summaries[name] = summary if math.isfinite(summary) else None
    return summaries
