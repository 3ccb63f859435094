"""A run in figures and words: what a reader wants first, how it was trained, what it lies in, how it is made again."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from spelgen.dynamics.residuals import used_parameter_count
from spelgen.errors import shortened
from spelgen.evaluation.results import Results
from spelgen.evaluation.tables import figures
from spelgen.fitting.run_folder import RunFolder
from spelgen.fitting.servo.report import servo_summary
from spelgen.fitting.torque.report import terms_in_use
from spelgen.labels import counted
from spelgen.listing import number
from spelgen.logs.preprocessing import Preprocessing
from spelgen.render.plots import Record
from spelgen.settings.fits import CONFIGS
from spelgen.settings.training import TrainingSettings
from spelgen.spec import Facts, Options

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel


def head_numbers(
    model: ArmModel | None, config: Record, metrics: Sequence[Record], results: Results | None
) -> list[tuple[str, str]]:
    """Return the figures a reader wants first, with what they are, as far as the run has come.

    Records are empty where there are none.
    """
    numbers = []
    if results is not None:
        for figure in figures(results):
            numbers.append((figure.text(), figure.label))
    summary = servo_summary(config)
    if summary is not None:
        numbers.append(summary.headline)
    elif model is not None:
        numbers.append((f"{used_parameter_count(model):,}", "trained parameters"))
    if metrics:
        label = f"of training, {metrics[-1]['step']:,} steps"
        numbers.append((_duration(metrics[-1]["seconds"]), label))
    return numbers


def best_epoch(metrics: Sequence[Record]) -> int:
    """Return the epoch of the model that was kept; 0: no epoch was better than the start."""
    best = metrics[-1]["best"]
    return next((record["epoch"] for record in metrics if record["validation"] == best), 0)


def training_facts(
    config: Record, metrics: Sequence[Record], identified: Record | None, model: ArmModel | None
) -> dict[str, str]:
    """Return how the run was trained, from its config.json, metrics.jsonl and the model that came of it."""
    preprocessing = Preprocessing(**config["preprocessing"])
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
    # fits to torques have no epochs
    if metrics:
        last, best = metrics[-1], best_epoch(metrics)
        origin = f"epoch {best}"
        if not best:
            origin = "the start: no epoch was better"
        facts["length"] = f"{last['epoch']} epochs, {last['step']:,} steps, {_duration(last['seconds'])}"
        facts["kept"] = f"the model of {origin}, validation loss {number(last['best'])}"
        if config["config"].get("solver", "rk4") == "rk4":
            facts["integrator"] = f"rk4, {counted(last['substeps'], 'step')} between samples"
    if config["config"].get("momentum_steps"):
        facts["start"] = f"{config['config']['momentum_steps']:,} steps on the momentum along the logs"
    return facts


def settings(config: Record) -> dict[str, str]:
    """Return what the objective was set to."""
    options = config["config"].items()
    return {key.replace("_", " "): str(value) for key, value in options if value is not None}


def _names(trajectories: Sequence[str]) -> str:
    return (
        f"{counted(len(trajectories), 'trajectory')}: {shortened(trajectories, 5)}"
        if trajectories
        else "none"
    )


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = seconds / 60
    return f"{minutes:.1f} min" if minutes < 100 else f"{minutes / 60:.1f} h"


def commands(run: RunFolder, facts: Facts, record: Record | None) -> list[str]:
    """Return what makes a run again, from its module and its config.json; the logs' place is not known to the run."""
    options = asdict(facts.options)
    if facts.options.design is not None:  # of a file that the run does not keep
        options["preset"] += ".yaml"
    # the module may name a folder of another machine before its URDF
    robot, option = shlex.quote(Path(facts.urdf).name), ""
    if run.urdf.exists():
        robot = f"RUN/{run.urdf.name}"
        option = f" --robot {robot}"
    build = f"spelgen build {robot}"
    for key, value in _changed(options, asdict(Options())).items():
        words = ",".join(value) if isinstance(value, (list, tuple)) else str(value)
        build += f" --{key.replace('_', '-')} {shlex.quote(words)}"
    lines = [f"{build} -o module.py"]
    if record:
        objective, chosen = record["objective"], ("validation_fraction", "seed")
        train = f"spelgen train module.py{option} --data LOGS -o RUN2 --objective {objective}"
        defaults = CONFIGS[objective]().model_dump(mode="json") | asdict(Preprocessing())
        defaults |= TrainingSettings().model_dump(include=set(chosen))
        options = {key: record[key] for key in chosen} | record["config"] | record["preprocessing"]
        for key, value in _changed(options, defaults).items():
            train += f" --set {shlex.quote(f'{key}={value}')}"
        lines.append(train)
    return [*lines, "spelgen evaluate RUN2 --data LOGS", "spelgen report RUN2"]


def _changed(options: Mapping[str, object], defaults: Mapping[str, object]) -> dict[str, object]:
    """Return the options that are set to something else than by default."""
    changed = {}
    for key, value in options.items():
        if value is not None and value != defaults.get(key) and not isinstance(value, Mapping):
            changed[key] = value
    return changed
