"""A run folder -> one self-contained HTML page. What the folder lacks is said, not guessed."""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from spelgen import __version__
from spelgen.errors import RunError
from spelgen.files import write_text
from spelgen.fitting.dataset import TrainingConfig
from spelgen.fitting.run_folder import RunFolder
from spelgen.render.learned import Learned, read_learned
from spelgen.render.picture import Picture, read_picture
from spelgen.render.plots import UNITS, joint_charts, loss_chart
from spelgen.render.tables import MODEL, number, result_tables, verdict
from spelgen.spec import Header, Options, read_header
from spelgen.templates import render

EXAMPLES = 2  # predicted trajectories that are drawn


@dataclass(frozen=True)
class Number:
    """One of the figures at the head of the page."""

    value: str
    label: str


@dataclass(frozen=True)
class File:
    """A file of the run folder."""

    name: str
    size: str
    sha256: str


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
    header, picture = read_header(run.module), read_picture(run.module)
    config = run.read_json(run.config) if run.config.is_file() else None
    metrics = _metrics(run.metrics)
    evaluation = run.read_json(run.evaluation) if run.evaluation.is_file() else None
    learned = read_learned(run) if run.weights.is_file() else None
    return render(
        "report.html.jinja",
        version=__version__,
        header=header,
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
                joint_charts(each, dict(zip(header.joints, header.joint_types, strict=True))),
            )
            for each in (evaluation or {}).get("examples", [])[:EXAMPLES]
        ],
        learned=learned,
        files=_files(run.path),
        commands=_commands(header, config),
    )


def _metrics(path: Path) -> list[dict[str, Any]]:
    """The lines of metrics.jsonl; the last may be torn where a run was killed, and is then left out."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    records = []
    for count, line in enumerate(lines, start=1):
        try:
            records.append(json.loads(line))
        except ValueError as error:
            if count < len(lines):
                raise RunError(f"broken JSON ({error})", file=path, line=count) from error
    return records


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
        errors = {name: each["mean_share"] for name, each in last["errors"].items()}
        rivals = ", ".join(f"{name} {number(value)}" for name, value in errors.items() if name != MODEL)
        found.append(
            Number(
                number(errors.get(MODEL)), f"error after {last['name']}, relative to the motion ({rivals})"
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
    facts = {
        "data": f"{config['training_windows']:,} windows from {_many(config['training'])}",
        "validation": f"{config['validation_windows']:,} windows from {_many(config['validation'])} held out",
        "start": f"{config['config']['momentum_steps']:,} steps on the momentum along the logs",
        "filter": f"{config['cutoff']:g} Hz, zero phase" if config["cutoff"] else "none",
        "length": f"{last['epoch']} epochs, {last['step']:,} steps, {_duration(last['seconds'])}",
        "kept": f"the model of {kept}, validation loss {number(best)}",
        "integrator": f"rk4, {last['substeps']} steps between samples",
        "setbacks": f"{last['rollbacks']} epochs undone" if last["rollbacks"] else "none",
    }
    settings = {key.replace("_", " "): str(x) for key, x in config["config"].items() if x is not None}
    return Training(loss_chart(metrics, best_epoch), facts, settings)


def _files(folder: Path) -> list[File]:
    """Every file of the folder but the page itself and what is being written."""
    paths = sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    return [
        File(path.name, _size(path.stat().st_size), hashlib.sha256(path.read_bytes()).hexdigest())
        for path in paths
        if path.suffix != ".html"
    ]


def _commands(header: Header, config: Mapping[str, Any] | None) -> list[str]:
    """What makes this run again; the logs' place is not known to the run."""
    options = _flags(asdict(header.options), asdict(Options()))
    commands = [f"spelgen build {shlex.quote(header.urdf)}{options} -o module.py"]
    if config:
        commands.append(
            f"spelgen train module.py --data LOGS -o RUN{_flags(config['config'], asdict(TrainingConfig()))}"
        )
    return [*commands, "spelgen evaluate RUN --data LOGS", "spelgen report RUN"]


def _flags(chosen: Mapping[str, Any], usual: Mapping[str, Any]) -> str:
    """The command-line flags of what differs from the default."""
    names = {"snap_tolerance": "snap-tol"}
    text = ""
    for key, value in chosen.items():
        if value is not None and value != usual.get(key):
            told = ",".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)
            text += f" --{names.get(key, key.replace('_', '-'))} {shlex.quote(told)}"
    return text


def _many(trajectories: Sequence[str]) -> str:
    return f"{len(trajectories)} trajector{'ies' if len(trajectories) != 1 else 'y'}"


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = seconds / 60
    return f"{minutes:.1f} min" if minutes < 100 else f"{minutes / 60:.1f} h"


def _size(count: int) -> str:
    return (
        f"{count} B" if count < 1000 else f"{count / 1000:.1f} kB" if count < 1e6 else f"{count / 1e6:.1f} MB"
    )
