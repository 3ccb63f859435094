"""A run in figures and words: what a reader wants first, and how it was trained."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from spelgen.baselines.names import MODEL
from spelgen.evaluation.results import Results
from spelgen.evaluation.tables import figures
from spelgen.fitting.objectives import fit_summary
from spelgen.fitting.torque.report import terms_in_use
from spelgen.labels import counted
from spelgen.listing import number
from spelgen.logs.preprocessing import Preprocessing
from spelgen.render.charts import Chart
from spelgen.render.plots import Record, loss_chart

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel


@dataclass(frozen=True)
class Number:
    """One of the figures at the head of the page."""

    value: str
    label: str


@dataclass(frozen=True)
class Training:
    """How the run went: its loss curves where it took epochs, what it was fitted to, and what it was set to."""

    chart: Chart | None
    facts: dict[str, str]
    settings: dict[str, str]


def head_numbers(
    model: EmittedModel | None, config: Record, metrics: Sequence[Record], results: Results | None
) -> list[Number]:
    """Return the figures a reader wants first, as far as the run has come; records are empty where there are none."""
    numbers = []
    if results is not None:
        for figure in figures(results):
            value = figure.values[MODEL]
            if value is not None:
                numbers.append(Number(figure.text(value), figure.label))
    summary = fit_summary(config)
    if summary is not None:
        numbers.append(Number(*summary.headline))
    elif model is not None:
        count = sum(parameter.numel() for parameter in model.parameters())
        numbers.append(Number(f"{count:,}", "trained parameters"))
    if metrics:
        label = f"of training, {metrics[-1]['step']:,} steps"
        numbers.append(Number(_duration(metrics[-1]["seconds"]), label))
    return numbers


def training_facts(
    config: Record, metrics: Sequence[Record], identified: Record | None, model: EmittedModel | None
) -> Training:
    """Return how the run was trained, from its config.json, metrics.jsonl and the model that came of it."""
    preprocessing, options = Preprocessing(**config["preprocessing"]), config["config"]
    facts = {
        "objective": config["objective"],
        "training logs": _names(config["training"]),
        "validation logs": _names(config["validation"]),
        "windows": f"{config['training_windows']:,} for training, {config['validation_windows']:,} for validation",
        "filter": f"{preprocessing.cutoff:g} Hz, zero phase" if preprocessing.filtered else "none",
    }
    if identified and "samples" in identified:
        count = f"{identified['samples']:,}"
        facts["dense samples"] = f"{count} that move, from which least squares is fitted as well"
    if model is not None and hasattr(model, "residuals"):
        facts["beside rigid bodies"] = "; ".join(terms_in_use(model)) or "nothing selected"
    chart = None
    # fits to torques have no epochs
    if metrics:
        last = metrics[-1]
        best_epoch, origin = 0, "the start: no epoch was better"
        for record in metrics:
            if record["validation"] == last["best"]:
                best_epoch, origin = record["epoch"], f"epoch {record['epoch']}"
                break
        facts["length"] = f"{last['epoch']} epochs, {last['step']:,} steps, {_duration(last['seconds'])}"
        facts["kept"] = f"the model of {origin}, validation loss {number(last['best'])}"
        facts["setbacks"] = f"{last['rollbacks']} epochs undone" if last["rollbacks"] else "none"
        if options.get("solver", "rk4") == "rk4":
            facts["integrator"] = f"rk4, {last['substeps']} steps between samples"
        chart = loss_chart(metrics, best_epoch)
    if options.get("momentum_steps"):
        facts["start"] = f"{options['momentum_steps']:,} steps on the momentum along the logs"
    settings = {key.replace("_", " "): str(value) for key, value in options.items() if value is not None}
    return Training(chart, facts, settings)


def _names(trajectories: Sequence[str]) -> str:
    count = len(trajectories)
    if not count:
        return "none"
    names = ", ".join(trajectories)
    if count > 6:
        names = f"{', '.join(trajectories[:5])} and {count - 5} more"
    return f"{counted(count, 'trajectory')}: {names}"


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = seconds / 60
    if minutes < 100:
        return f"{minutes:.1f} min"
    return f"{minutes / 60:.1f} h"
