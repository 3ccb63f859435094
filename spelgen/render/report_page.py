"""A run folder -> one self-contained HTML page. What the folder lacks is said, not guessed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from spelgen import __version__
from spelgen.errors import RunError
from spelgen.evaluation.baselines import MODEL
from spelgen.evaluation.tables import result_tables, verdict
from spelgen.files import write_text
from spelgen.fitting.run_folder import RunFolder
from spelgen.listing import number
from spelgen.logs.preprocessing import Preprocessing
from spelgen.render.learned import Learned, read_learned
from spelgen.render.picture import Picture, read_picture
from spelgen.render.plots import UNITS, joint_charts, loss_chart
from spelgen.render.reproduction import commands, files
from spelgen.spec import read_facts
from spelgen.templates import render

EXAMPLES = 2  # predicted trajectories that are drawn


@dataclass(frozen=True)
class Number:
    """One of the figures at the head of the page."""

    value: str
    label: str


@dataclass(frozen=True)
class Training:
    """How the run went: its loss curves and what it was set to."""

    chart: Markup
    facts: dict[str, str]
    settings: dict[str, str]


def write_report(folder: Path | str, output: Path | str | None = None) -> Path:
    """Write the page about a run, by default as report.html in its folder; return its path.

    Raises RunError or ModuleError when the folder is no run, or a file of it cannot be read.
    """
    folder = Path(folder)
    return write_text(Path(output) if output else folder / "report.html", render_report(folder))


def render_report(folder: Path | str) -> str:
    """The page about a run as HTML; the same folder gives the same text."""
    run = RunFolder(Path(folder))
    if not run.module.is_file():
        raise RunError(
            "no run", file=run.path, expected="a folder with module.py", do="make one with `spelgen train`"
        )
    facts, picture = read_facts(run.module), read_picture(run.module)
    config = run.read_json(run.config) if run.config.is_file() else None
    metrics = run.read_metrics()
    evaluation = run.read_json(run.evaluation) if run.evaluation.is_file() else None
    learned = read_learned(run) if run.weights.is_file() else None
    return render(
        "report.html.jinja",
        version=__version__,
        facts=facts,
        picture=picture,
        units=UNITS,
        numbers=_numbers(picture, learned, metrics, evaluation),
        verdict=verdict(evaluation) if evaluation else None,
        config=config,
        training=_training(config, metrics) if config and metrics else None,
        evaluation=evaluation,
        tables=result_tables(evaluation) if evaluation else [],
        examples=[
            (
                each["trajectory"],
                joint_charts(each, dict(zip(facts.joints, facts.joint_types, strict=True))),
            )
            for each in (evaluation or {}).get("examples", [])[:EXAMPLES]
        ],
        learned=learned,
        files=files(run.path),
        commands=commands(facts, config),
    )


def _numbers(
    picture: Picture,
    learned: Learned | None,
    metrics: Sequence[Mapping[str, Any]],
    evaluation: Mapping[str, Any] | None,
) -> list[Number]:
    """The figures a reader wants first, as far as the run has come."""
    found = []
    if evaluation and evaluation["horizons"]:
        last = evaluation["horizons"][-1]
        errors = {name: each["mean_relative_rms"] for name, each in last["errors"].items()}
        others = ", ".join(f"{name} {number(value)}" for name, value in errors.items() if name != MODEL)
        found.append(
            Number(
                number(errors.get(MODEL)), f"error after {last['name']}, relative to the motion ({others})"
            )
        )
        if last["errors"][MODEL]["tip_mm"] is not None:
            found.append(
                Number(
                    f"{number(last['errors'][MODEL]['tip_mm'])} mm", f"error of the tip after {last['name']}"
                )
            )
    if learned:
        found.append(Number(f"{learned.parameters:,}", "trained parameters"))
    if metrics:
        found.append(Number(_duration(metrics[-1]["seconds"]), f"of training, {metrics[-1]['step']:,} steps"))
    varying = sum(cell.kind == "varying" for i, row in enumerate(picture.rows) for cell in row[: i + 1])
    entries = len(picture.rows) * (len(picture.rows) + 1) // 2
    found.append(Number(f"{varying} of {entries}", "entries of the mass matrix vary"))
    return found


def _training(config: Mapping[str, Any], metrics: Sequence[Mapping[str, Any]]) -> Training:
    last, best = metrics[-1], metrics[-1]["best"]
    best_epoch = next((each["epoch"] for each in metrics if each["validation"] == best), 0)
    kept = f"epoch {best_epoch}" if best_epoch else "the start: no epoch was better"
    used, chosen = Preprocessing(**config["preprocessing"]), config["config"]
    facts = {
        "objective": config["objective"],
        "data": f"{config['training_windows']:,} windows from {_many(config['training'])}",
        "validation": f"{config['validation_windows']:,} windows from {_many(config['validation'])} held out",
        "filter": f"{used.cutoff:g} Hz, zero phase" if used.filtered else "none",
        "length": f"{last['epoch']} epochs, {last['step']:,} steps, {_duration(last['seconds'])}",
        "kept": f"the model of {kept}, validation loss {number(best)}",
        "setbacks": f"{last['rollbacks']} epochs undone" if last["rollbacks"] else "none",
    }
    if chosen.get("momentum_steps"):
        facts["start"] = f"{chosen['momentum_steps']:,} steps on the momentum along the logs"
    if chosen.get("solver", "rk4") == "rk4":
        facts["integrator"] = f"rk4, {last['substeps']} steps between samples"
    settings = {key.replace("_", " "): str(x) for key, x in chosen.items() if x is not None}
    return Training(loss_chart(metrics, best_epoch), facts, settings)


def _many(trajectories: Sequence[str]) -> str:
    return f"{len(trajectories)} trajector{'ies' if len(trajectories) != 1 else 'y'}"


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = seconds / 60
    return f"{minutes:.1f} min" if minutes < 100 else f"{minutes / 60:.1f} h"
