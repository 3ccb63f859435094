"""Several runs -> one self-contained page that sets them side by side."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from spelgen.baselines.names import MODEL
from spelgen.errors import RunError
from spelgen.evaluation.results import Results
from spelgen.evaluation.tables import Table, table
from spelgen.evaluation.verdict import verdict
from spelgen.files import write_text
from spelgen.fitting.run_folder import RunFolder
from spelgen.labels import listed, named_joints, thousandths
from spelgen.listing import number
from spelgen.render.page import render_page
from spelgen.render.plots import ERRORS, Growth, Panel, Record, growth_panels
from spelgen.spec import Facts, read_facts

MEASURES = {
    "mean_relative_rms": "Error relative to the motion",
    "tip_mm": "Error of the tip's position [mm]",
}
Errors = dict[str, float | None]
"""By the names of runs."""
STYLES = ("model", "train", "gravity", "coriolis", "friction", "hold")


@dataclass(frozen=True)
class EvaluatedRun:
    """A run as the page tells of it; style: of its lines."""

    name: str
    style: str
    facts: Facts
    objective: str
    parameters: str
    verdict: str
    evaluation: Record

    def names(self, kind: str) -> list[str]:
        """Return the names of the horizons, or of the replays, that the run was judged over."""
        return [judged["name"] for judged in self.evaluation.get(kind, ())]

    def errors(self, kind: str, name: str) -> Record:
        """Return the model's errors over a horizon or a replay of this name."""
        judged: Record = self.evaluation[kind][self.names(kind).index(name)]["errors"][MODEL]
        return judged

    @property
    def torque(self) -> Record:
        """Return the model's errors of torque; empty where the logs tell none."""
        errors: Record = self.evaluation["torque"].get(MODEL, {})
        return errors


def write_runs(folders: Sequence[Path], output: Path) -> Path:
    """Write the page about these runs; return its path. Raises RunError where one is no run, or not evaluated."""
    return write_text(output, render_runs(folders))


def render_runs(folders: Sequence[Path]) -> str:
    """Return the page as HTML."""
    runs = []
    # a seventh run has the style of the first again
    for folder, name, style in zip(folders, _names(folders), STYLES * len(folders), strict=False):
        runs.append(_read(folder, name, style))
    return render_page(
        "runs.html.jinja",
        runs=runs,
        verdict=_verdict(runs),
        robots=sorted({run.facts.robot for run in runs}),
        tables=_tables(runs),
        growth=_growth(runs),
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
    evaluation = run.read_json(run.evaluation)
    identified = run.read_json(run.baseline) if run.baseline.is_file() else None
    return EvaluatedRun(
        name=name,
        style=style,
        facts=read_facts(run.module),
        objective=config["objective"],
        parameters=f"{evaluation['parameters']:,}",
        verdict=verdict(Results.from_dict(evaluation), identified).sentence,
        evaluation=evaluation,
    )


def _verdict(runs: Sequence[EvaluatedRun]) -> str:
    """Say which run misses least over the longest horizon that all have, which in torque, which under commands."""
    comparisons: list[tuple[str, str, Errors]] = []
    # the longest horizon is the hardest
    for horizon in _common(runs, "horizons")[-1:]:
        errors = _horizon_errors(runs, horizon, "mean_relative_rms")
        comparisons.append((f"rollout error over {horizon}", "of the motion", errors))
    comparisons.append(("torque error", "of the variance", _torque_errors(runs)))
    for replay in _common(runs, "replays")[:1]:
        unit = thousandths(runs[0].facts.joint_types)
        comparisons.append((f"error with commands replayed, {replay}", unit, _replay_errors(runs, replay)))
    sentences = []
    for quantity, unit, errors in comparisons:
        finite = [(error, name) for name, error in errors.items() if error is not None]
        if finite:
            error, name = min(finite)
            sentences.append(f"{name} has the smallest {quantity} ({number(error)} {unit})")
    if not sentences:
        return "These runs have no common horizons or logs."
    return f"{listed(sentences)}."


def _common(runs: Sequence[EvaluatedRun], kind: str) -> list[str]:
    """Return the names of the horizons, or of the replays, that all runs were judged over."""
    return _in_all([run.names(kind) for run in runs])


def _in_all(lists: Sequence[Iterable[str]]) -> list[str]:
    """Return the names that stand in all lists, in the order of the first."""
    names = list(lists[0])
    for other in lists[1:]:
        names = [name for name in names if name in other]
    return names


def _tables(runs: Sequence[EvaluatedRun]) -> list[Table]:
    tables = []
    horizons = _common(runs, "horizons")
    for measure, title in MEASURES.items():
        rows = [_horizon_errors(runs, horizon, measure) for horizon in horizons]
        if any(set(row.values()) != {None} for row in rows):  # there is no tip without a URDF
            tables.append(table(title, horizons, rows))
    if all(run.torque for run in runs):
        tables += _torque_tables(runs)
    for replay in _common(runs, "replays"):
        tables.append(_replay_table(runs, replay))
    return tables


def _horizon_errors(runs: Sequence[EvaluatedRun], horizon: str, measure: str) -> Errors:
    return {run.name: run.errors("horizons", horizon)[measure] for run in runs}


def _torque_errors(runs: Sequence[EvaluatedRun]) -> Errors:
    """Return the mean nMSE of torques by run, None where its logs tell none."""
    return {run.name: run.torque.get("mean_nmse") for run in runs}


def _replay_errors(runs: Sequence[EvaluatedRun], replay: str) -> Errors:
    """Return the mean errors of positions under the commands of these logs [mrad; mm]."""
    return {run.name: 1000 * run.errors("replays", replay)["mean"] for run in runs}


def _torque_tables(runs: Sequence[EvaluatedRun]) -> list[Table]:
    facts = runs[0].facts
    tables = [table("Torque error, nMSE", ["mean of all"], [_torque_errors(runs)])]
    # joints of other arms have nothing to be compared with
    if all(run.facts.joints == facts.joints for run in runs):
        labels, rows = [], []
        for k, joint in enumerate(named_joints(facts.joints, facts.joint_types)):
            labels.append(f"{joint.name} [{joint.units.torque}]")
            rows.append({run.name: run.torque["rmse"][k] for run in runs})
        tables.append(table("Torque error by joint, RMSE", labels, rows))
    return tables


def _replay_table(runs: Sequence[EvaluatedRun], name: str) -> Table:
    """Return errors of the logs that all runs have replayed, and the mean of each run's own."""
    errors = {run.name: run.errors("replays", name)["trajectories"] for run in runs}
    logs = _in_all(list(errors.values()))
    rows: list[Errors] = []
    for log in logs:
        rows.append({run: 1000 * error[log] for run, error in errors.items()})
    rows.append(_replay_errors(runs, name))
    unit = thousandths(runs[0].facts.joint_types)
    return table(f"Commands replayed, {name}: RMS of positions [{unit}]", [*logs, "mean of all"], rows)


def _growth(runs: Sequence[EvaluatedRun]) -> list[Panel]:
    growths = []
    for run in runs:
        growth = (run.evaluation.get("traces") or {}).get("growth") or {}
        errors = {}
        for measure in ERRORS:
            error = growth.get(measure, {}).get(MODEL)
            if error:
                errors[measure] = error
        if errors:
            growths.append(Growth(run.name, run.style, True, growth["seconds"], errors))
    return growth_panels(growths)
