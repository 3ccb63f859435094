"""Several runs -> one self-contained page that sets them side by side."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from spelgen.baselines.names import MODEL
from spelgen.errors import RunError
from spelgen.evaluation.results import Results
from spelgen.evaluation.tables import Table, table
from spelgen.evaluation.verdict import verdict
from spelgen.files import write_text
from spelgen.fitting.run_folder import RunFolder
from spelgen.labels import listed, thousandths
from spelgen.listing import number
from spelgen.render.charts import Band, Line, line_chart
from spelgen.render.page import render_page
from spelgen.render.plots import FORCE, Panel, numbers
from spelgen.spec import Facts, read_facts

STYLES = ("model", "train", "gravity", "coriolis", "friction", "hold")


@dataclass(frozen=True)
class RunShown:
    """A run as the page tells of it; style: of its lines."""

    name: str
    style: str
    facts: Facts
    objective: str
    parameters: str
    verdict: str
    evaluation: Mapping[str, Any]


def write_runs(folders: Sequence[Path], output: Path) -> Path:
    """Write the page about these runs; return its path. Raises RunError where one is no run, or not evaluated."""
    return write_text(output, render_runs(folders))


def render_runs(folders: Sequence[Path]) -> str:
    """The page as HTML."""
    runs = [
        _shown(folder, name, k) for k, (folder, name) in enumerate(zip(folders, _names(folders), strict=True))
    ]
    return render_page(
        "runs.html.jinja",
        runs=runs,
        verdict=_best(runs),
        robots=sorted({run.facts.robot for run in runs}),
        key=[(run.style, run.name) for run in runs],
        tables=_tables(runs),
        growth=_growth(runs),
    )


def _names(folders: Sequence[Path]) -> list[str]:
    """The folders' own names, with their parents' where two are the same."""
    short = [folder.resolve().name for folder in folders]
    return [
        name if short.count(name) == 1 else "/".join(folder.resolve().parts[-2:])
        for folder, name in zip(folders, short, strict=True)
    ]


def _shown(folder: Path, name: str, index: int) -> RunShown:
    run = RunFolder(folder)
    config = run.read_config()
    if not run.evaluation.is_file():
        raise RunError("a run that is not evaluated", file=folder, do="spelgen evaluate")
    evaluation = run.read_json(run.evaluation)
    identified = run.read_json(run.baseline) if run.baseline.is_file() else None
    return RunShown(
        name=name,
        style=STYLES[index % len(STYLES)],
        facts=read_facts(run.module),
        objective=config["objective"],
        parameters=f"{evaluation['parameters']:,}",
        verdict=verdict(Results.from_dict(evaluation), identified).sentence,
        evaluation=evaluation,
    )


def _best(runs: Sequence[RunShown]) -> str:
    """Which run misses least over the longest horizon that all have, and which in torque."""
    told = []
    common, replayed = (_common(runs, what) for what in ("horizons", "replays"))
    if common:
        least = _least(runs, lambda run: _of_model(run, "horizons", common[-1])["mean_relative_rms"])
        told += (
            [f"{least[0]} predicts best over {common[-1]} ({number(least[1])} of the motion missed)"]
            if least
            else []
        )
    least = _least(runs, lambda run: (run.evaluation["torque"].get(MODEL) or {}).get("mean_nmse"))
    told += [f"{least[0]} has the least torque error (nMSE {number(least[1])})"] if least else []
    if replayed:
        least = _least(runs, lambda run: 1000 * _of_model(run, "replays", replayed[0])["mean"])
        unit = thousandths(runs[0].facts.joint_types)
        told += (
            [f"{least[0]} follows commands best, {replayed[0]} ({number(least[1])} {unit} off)"]
            if least
            else []
        )
    return f"{listed(told)}." if told else "These runs share nothing that was measured."


def _least(runs: Sequence[RunShown], value: Callable[[RunShown], float | None]) -> tuple[str, float] | None:
    known = [(x, run.name) for run in runs if (x := value(run)) is not None]
    return (min(known)[1], min(known)[0]) if known else None


def _common(runs: Sequence[RunShown], what: str) -> list[str]:
    """Names of the horizons, or of the replays, that all runs were judged over."""
    first, *rest = ([x["name"] for x in run.evaluation.get(what, ())] for run in runs)
    return [name for name in first if all(name in other for other in rest)]


def _of_model(run: RunShown, what: str, name: str) -> Mapping[str, Any]:
    """The model's errors over one of these."""
    errors: Mapping[str, Any] = next(x["errors"][MODEL] for x in run.evaluation[what] if x["name"] == name)
    return errors


def _replay_table(runs: Sequence[RunShown], name: str) -> Table:
    """Of logs that all runs have replayed, and the mean of each run's own."""
    of_runs = {run.name: _of_model(run, "replays", name) for run in runs}
    first, *rest = (x["trajectories"] for x in of_runs.values())
    logs = [log for log in first if all(log in other for other in rest)]
    rows = [{k: 1000 * x["trajectories"][log] for k, x in of_runs.items()} for log in logs]
    rows.append({k: 1000 * x["mean"] for k, x in of_runs.items()})
    title = f"Commands replayed, {name}: RMS of positions [{thousandths(runs[0].facts.joint_types)}]"
    return table(title, [*logs, "mean of all"], rows)


def _tables(runs: Sequence[RunShown]) -> list[Table]:
    names, found = _common(runs, "horizons"), []
    for what, title in (
        ("mean_relative_rms", "Error relative to the motion"),
        ("tip_mm", "Error of the tip's position [mm]"),
    ):
        rows = [{run.name: _of_model(run, "horizons", name)[what] for run in runs} for name in names]
        if any(x is not None for row in rows for x in row.values()):
            found.append(table(title, names, rows))
    torques = [run.evaluation["torque"].get(MODEL) for run in runs]
    if all(torques):
        columns = dict(zip((run.name for run in runs), torques, strict=True))
        found.append(
            table("Torque error, nMSE", ["mean of all"], [{k: x["mean_nmse"] for k, x in columns.items()}])
        )
        joints = {run.facts.joints: run.facts.joint_types for run in runs}
        if len(joints) == 1:
            ((names_of, types),) = joints.items()
            labels = [f"{joint} [{FORCE[kind]}]" for joint, kind in zip(names_of, types, strict=True)]
            rows = [{k: x["rmse"][j] for k, x in columns.items()} for j in range(len(labels))]
            found.append(table("Torque error by joint, RMSE", labels, rows))
    return [*found, *(_replay_table(runs, name) for name in _common(runs, "replays"))]


def _growth(runs: Sequence[RunShown]) -> list[Panel]:
    panels = []
    for what, title, label in (
        ("relative", "Relative to the motion", "error / motion"),
        ("tip_mm", "Of the tip", "error of the tip [mm]"),
    ):
        shown: list[Line | Band] = []
        for run in runs:
            growth = (run.evaluation.get("traces") or {}).get("growth") or {}
            curves = growth.get(what, {}).get(MODEL)
            if curves:
                seconds = growth["seconds"]
                shown.append(Line(f"{run.name}, median", seconds, numbers(curves["median"]), run.style))
                shown.append(
                    Band(
                        f"{run.name}, 10 to 90 %",
                        seconds,
                        numbers(curves["low"]),
                        numbers(curves["high"]),
                        run.style,
                    )
                )
        if shown:
            chart: Markup = line_chart(
                shown,
                f"{title}: error by horizon",
                "horizon [s]",
                label,
                log=True,
                log_x=True,
                width=520,
                height=260,
            )
            panels.append(Panel(title, (chart,)))
    return panels
