"""A run in figures and words: what a reader wants first, how it was trained, what it lies in, how it is made again."""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.filesize import decimal

from spelgen.baselines.names import MODEL
from spelgen.evaluation.results import Results
from spelgen.evaluation.tables import figures
from spelgen.fitting.run_folder import RunFolder
from spelgen.fitting.servo.report import servo_summary
from spelgen.fitting.torque.report import terms_in_use
from spelgen.labels import counted
from spelgen.listing import number
from spelgen.logs.preprocessing import Preprocessing
from spelgen.render.charts import Chart
from spelgen.render.plots import Record, loss_chart
from spelgen.settings.fits import CONFIGS
from spelgen.settings.training import TrainingSettings
from spelgen.spec import Facts, Options

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel


HASHED = 1_000_000_000  # bytes of the largest file whose digest is computed, in some seconds


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
    summary = servo_summary(config)
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


def files(folder: Path) -> list[tuple[str, str, str]]:
    """Return name, size and SHA-256 of every file of the folder but pages and what is being written."""
    entries = []
    for path in sorted(folder.iterdir()):
        # pages are made from the folder and so are no part of what is reproduced
        if path.is_file() and not path.name.startswith(".") and path.suffix != ".html":
            size, digest = path.stat().st_size, "not computed of a file above 1 GB"
            if size <= HASHED:
                with path.open("rb") as content:
                    digest = hashlib.file_digest(content, "sha256").hexdigest()
            entries.append((path.name, decimal(size), digest))
    return entries


def commands(run: RunFolder, facts: Facts, record: Record | None) -> list[str]:
    """Return what makes a run again, from its config.json; the logs' place is not known to the run."""
    # the module may name a folder of another machine before its URDF, the run calls it robot.urdf
    name = Path(facts.urdf).name
    urdf = shlex.quote(name)
    lines = []
    if run.urdf.exists():  # under the name that the module knows it by
        lines.append(f"cp RUN/{run.urdf.name} {urdf}")
        if run.settings.exists():
            lines.append(f"cp RUN/{run.settings.name} {shlex.quote(str(Path(name).with_suffix('.yaml')))}")
    build = f"spelgen build {urdf}"
    for key, value in _changed(asdict(facts.options), asdict(Options())).items():
        words = ",".join(value) if isinstance(value, (list, tuple)) else str(value)
        build += f" --{key.replace('_', '-')} {shlex.quote(words)}"
    lines.append(f"{build} -o module.py")
    if record:
        defaults = CONFIGS[record["objective"]]().model_dump(mode="json") | asdict(Preprocessing())
        defaults |= TrainingSettings().model_dump(include={"validation_fraction", "seed"})
        options = {"validation_fraction": record["validation_fraction"], "seed": record["seed"]}
        train = (
            f"spelgen train module.py --robot {urdf} --data LOGS -o RUN2 --objective {record['objective']}"
        )
        for key, value in _changed(options | record["config"] | record["preprocessing"], defaults).items():
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
