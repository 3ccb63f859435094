"""A run in figures and words: what a reader wants first, and how it was trained."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from spelgen.baselines.names import MODEL
from spelgen.fitting.servo_report import delay_text
from spelgen.labels import thousandths
from spelgen.listing import number
from spelgen.logs.preprocessing import Preprocessing
from spelgen.render.learned import Learned
from spelgen.render.plots import loss_chart


@dataclass(frozen=True)
class Number:
    """One of the figures at the head of the page."""

    value: str
    label: str


@dataclass(frozen=True)
class Training:
    """How the run went: its loss curves where it took epochs, what it was fitted to, and what it was set to."""

    chart: Markup | None
    facts: dict[str, str]
    settings: dict[str, str]


def head_numbers(
    learned: Learned | None,
    config: Mapping[str, Any] | None,
    metrics: Sequence[Mapping[str, Any]],
    evaluation: Mapping[str, Any] | None,
) -> list[Number]:
    """The figures a reader wants first, as far as the run has come."""
    found = []
    torque = evaluation["torque"].get(MODEL) if evaluation else None
    if torque and torque["mean_nmse"] is not None:
        found.append(
            Number(f"{100 * torque['mean_nmse']:.3g} %", "of the torque's variance is not explained")
        )
    if evaluation and evaluation["horizons"]:
        last = evaluation["horizons"][-1]
        error = last["errors"][MODEL]
        if error["mean_relative_rms"] is not None:
            found.append(
                Number(
                    f"{100 * error['mean_relative_rms']:.3g} %",
                    f"of the motion is missed after {last['name']}",
                )
            )
        if error["tip_mm"] is not None:
            found.append(Number(f"{number(error['tip_mm'])} mm", f"error of the tip after {last['name']}"))
    for replay in (evaluation or {}).get("replays", ()):
        unit = thousandths((evaluation or {}).get("joint_types", ()))
        error = f"{number(1000 * replay['errors'][MODEL]['mean'])} {unit}"
        found.append(Number(error, f"off measured positions, commands replayed, {replay['name']}"))
    if config and "servo" in config:
        found.append(Number(delay_text(config["servo"]), "from commands to what they do"))
    elif learned:
        found.append(Number(f"{learned.parameters:,}", "trained parameters"))
    if metrics:
        found.append(Number(_duration(metrics[-1]["seconds"]), f"of training, {metrics[-1]['step']:,} steps"))
    return found


def training_facts(
    config: Mapping[str, Any], metrics: Sequence[Mapping[str, Any]], identified: Mapping[str, Any] | None
) -> Training:
    """How the run was trained, from its config.json and metrics.jsonl."""
    used, chosen = Preprocessing(**config["preprocessing"]), config["config"]
    facts = {
        "objective": config["objective"],
        "training logs": _named(config["training"]),
        "validation logs": _named(config["validation"]),
        "windows": f"{config['training_windows']:,} to train, {config['validation_windows']:,} held out",
        "filter": f"{used.cutoff:g} Hz, zero phase" if used.filtered else "none",
    }
    if identified and "samples" in identified:
        facts["dense samples"] = (
            f"{identified['samples']:,} that move, from which least squares is fitted as well"
        )
    chart = None
    if metrics:
        last, best = metrics[-1], metrics[-1]["best"]
        best_epoch = next((each["epoch"] for each in metrics if each["validation"] == best), 0)
        kept = f"epoch {best_epoch}" if best_epoch else "the start: no epoch was better"
        facts["length"] = f"{last['epoch']} epochs, {last['step']:,} steps, {_duration(last['seconds'])}"
        facts["kept"] = f"the model of {kept}, validation loss {number(best)}"
        facts["setbacks"] = f"{last['rollbacks']} epochs undone" if last["rollbacks"] else "none"
        if chosen.get("solver", "rk4") == "rk4":
            facts["integrator"] = f"rk4, {last['substeps']} steps between samples"
        chart = loss_chart(metrics, best_epoch)
    if chosen.get("momentum_steps"):
        facts["start"] = f"{chosen['momentum_steps']:,} steps on the momentum along the logs"
    settings = {key.replace("_", " "): str(x) for key, x in chosen.items() if x is not None}
    return Training(chart, facts, settings)


def _named(trajectories: Sequence[str]) -> str:
    count = len(trajectories)
    names = ", ".join(trajectories) if count <= 6 else f"{', '.join(trajectories[:5])} and {count - 5} more"
    return f"{count} trajector{'ies' if count != 1 else 'y'}: {names}" if count else "none"


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = seconds / 60
    return f"{minutes:.1f} min" if minutes < 100 else f"{minutes / 60:.1f} h"
