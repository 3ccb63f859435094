"""Several runs -> one self-contained page that sets them side by side: one evaluation in which runs are predictors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from spelgen.baselines.names import MODEL
from spelgen.errors import RunError
from spelgen.evaluation.horizons import Horizon
from spelgen.evaluation.replay import Replay
from spelgen.evaluation.results import Results
from spelgen.evaluation.tables import Numbers, result_tables
from spelgen.evaluation.verdict import verdict
from spelgen.files import write_text
from spelgen.fitting.run_folder import RunFolder
from spelgen.labels import listed, thousandths
from spelgen.listing import number
from spelgen.render.page import render_page
from spelgen.render.plots import growth_panels
from spelgen.spec import Facts, read_facts

STYLES = ("model", "train", "gravity", "coriolis", "friction", "hold")
Judged = TypeVar("Judged", Horizon, Replay)


@dataclass(frozen=True)
class EvaluatedRun:
    """A run as the page tells of it; style: of its lines."""

    name: str
    style: str
    facts: Facts
    objective: str
    verdict: str
    results: Results


def write_runs(folders: Sequence[Path], output: Path) -> Path:
    """Write the page about these runs; return its path. Raises RunError where one is no run, or not evaluated."""
    return write_text(output, render_runs(folders))


def render_runs(folders: Sequence[Path]) -> str:
    """Return the page as HTML."""
    runs = []
    # a seventh run has the style of the first again
    for folder, name, style in zip(folders, _names(folders), STYLES * len(folders), strict=False):
        runs.append(_read(folder, name, style))
    results = _merged(runs)
    return render_page(
        "runs.html.jinja",
        runs=runs,
        verdict=_verdict(results),
        robots=sorted({run.facts.robot for run in runs}),
        tables=result_tables(results),
        growth=growth_panels(
            {run.name: (run.results.traces.growth, MODEL) for run in runs if run.results.traces.growth},
            {run.name: run.style for run in runs},
            [run.name for run in runs],
        ),
    )


def _names(folders: Sequence[Path]) -> list[str]:
    """Return the folders' own names, with their parents' where two are the same."""
    paths = [folder.resolve() for folder in folders]
    short = [path.name for path in paths]
    return [path.name if short.count(path.name) == 1 else "/".join(path.parts[-2:]) for path in paths]


def _read(folder: Path, name: str, style: str) -> EvaluatedRun:
    run = RunFolder(folder)
    config = run.read_config()
    if not run.evaluation.is_file():
        raise RunError("a run that is not evaluated", file=folder, do="spelgen evaluate")
    identified = run.read_json(run.baseline) if run.baseline.is_file() else None
    results = Results.from_dict(run.read_json(run.evaluation))
    return EvaluatedRun(
        name=name,
        style=style,
        facts=read_facts(run.module),
        objective=config["objective"],
        verdict=verdict(results, identified).sentence,
        results=results,
    )


def _merged(runs: Sequence[EvaluatedRun]) -> Results:
    """Return what all runs were evaluated on, with the errors of their models by the runs' names."""
    first = runs[0].results
    joints, torque = first.joints, {}
    # joints of other arms have nothing to be compared with
    if any(run.results.joints != joints for run in runs):
        joints = ()
    if all(MODEL in run.results.torque for run in runs):
        torque = {run.name: run.results.torque[MODEL] for run in runs}
    return replace(
        first,
        joints=joints,
        torque=torque,
        torque_steps={},
        horizons=_common({run.name: run.results.horizons for run in runs}),
        replays=_common({run.name: run.results.replays for run in runs}),
    )


def _common(by_run: Mapping[str, Sequence[Judged]]) -> tuple[Judged, ...]:
    """Return the horizons, or the replays, that all runs were judged over, with the models' errors by run."""
    common = []
    for judged in next(iter(by_run.values())):
        errors = {}
        for run, candidates in by_run.items():
            for candidate in candidates:
                if candidate.name == judged.name:
                    errors[run] = candidate.errors[MODEL]
        if len(errors) == len(by_run):
            common.append(replace(judged, errors=errors))
    return tuple(common)


def _verdict(results: Results) -> str:
    """Say which run misses least over the longest horizon that all have, which in torque, which under commands."""
    comparisons: list[tuple[str, str, Numbers]] = []
    # the longest horizon is the hardest
    for horizon in results.horizons[-1:]:
        relative = {name: x.mean_relative_rms for name, x in horizon.errors.items()}
        comparisons.append((f"rollout error over {horizon.name}", "of the motion", relative))
    nmse = {name: x.mean_nmse for name, x in results.torque.items()}
    comparisons.append(("torque error", "of the variance", nmse))
    for replay in results.replays[:1]:
        unit = thousandths(results.joint_types)
        means = {name: 1000 * x.mean for name, x in replay.errors.items()}
        comparisons.append((f"error with commands replayed, {replay.name}", unit, means))
    sentences = []
    for quantity, unit, errors in comparisons:
        finite = [(error, name) for name, error in errors.items() if error is not None]
        if finite:
            error, name = min(finite)
            sentences.append(f"{name} has the smallest {quantity} ({number(error)} {unit})")
    if not sentences:
        return "These runs have no common horizons or logs."
    return f"{listed(sentences)}."
