"""Several runs -> one self-contained page that sets them side by side."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from spelgen.baselines.names import MODEL
from spelgen.errors import RunError
from spelgen.evaluation.results import Results
from spelgen.evaluation.tables import Table, table
from spelgen.evaluation.verdict import verdict
from spelgen.files import write_text
from spelgen.fitting.run_folder import RunFolder
from spelgen.labels import listed, thousandths
from spelgen.listing import number
from spelgen.render.page import render_page
from spelgen.render.plots import ERRORS, FORCE, Panel, Record, growth_panels
from spelgen.spec import Facts, read_facts

MEASURES = {
    "mean_relative_rms": "Error relative to the motion",
    "tip_mm": "Error of the tip's position [mm]",
}
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

    def errors(self, kind: str, name: str) -> Record:
        """Return the model's errors over a horizon or a replay of this name."""
        record: Record = next(x["errors"][MODEL] for x in self.evaluation[kind] if x["name"] == name)
        return record

    def torque(self) -> Record | None:
        """Return the model's errors of torque; None where the logs tell none."""
        record: Record | None = self.evaluation["torque"].get(MODEL)
        return record

    def replay_error(self, name: str) -> float:
        """Return the mean error of positions under the commands of these logs [mrad; mm]."""
        return 1000 * float(self.errors("replays", name)["mean"])


def write_runs(folders: Sequence[Path], output: Path) -> Path:
    """Write the page about these runs; return its path. Raises RunError where one is no run, or not evaluated."""
    return write_text(output, render_runs(folders))


def render_runs(folders: Sequence[Path]) -> str:
    """Return the page as HTML."""
    runs = []
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
    sentences = []
    for horizon in _common(runs, "horizons")[-1:]:
        best = _best(_horizon_errors(runs, horizon, "mean_relative_rms"))
        if best:
            sentences.append(
                f"{best[1]} has the smallest rollout error over {horizon} ({number(best[0])} of the motion)"
            )
    best = _best(_torque_errors(runs))
    if best:
        sentences.append(f"{best[1]} has the smallest torque error (nMSE {number(best[0])})")
    for replay in _common(runs, "replays")[:1]:
        best = _best(_replay_errors(runs, replay))
        if best:
            unit = thousandths(runs[0].facts.joint_types)
            sentences.append(
                f"{best[1]} has the smallest error with commands replayed, {replay} ({number(best[0])} {unit})"
            )
    if not sentences:
        return "These runs have no common horizons or logs."
    return f"{listed(sentences)}."


def _best(errors: Mapping[str, float | None]) -> tuple[float, str] | None:
    """Return the smallest error and the name of its run; None where no run has one."""
    finite = [(error, name) for name, error in errors.items() if error is not None]
    return min(finite, default=None)


def _common(runs: Sequence[EvaluatedRun], kind: str) -> list[str]:
    """Return the names of the horizons, or of the replays, that all runs were judged over."""
    names = []
    for run in runs:
        names.append([x["name"] for x in run.evaluation.get(kind, ())])
    return _in_all(names)


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
    tables += _torque_tables(runs)
    for replay in _common(runs, "replays"):
        tables.append(_replay_table(runs, replay))
    return tables


def _horizon_errors(runs: Sequence[EvaluatedRun], horizon: str, measure: str) -> dict[str, float | None]:
    return {run.name: run.errors("horizons", horizon)[measure] for run in runs}


def _torque_errors(runs: Sequence[EvaluatedRun]) -> dict[str, float | None]:
    """Return the mean nMSE of torques by run, None where its logs tell none."""
    errors: dict[str, float | None] = {}
    for run in runs:
        torque = run.torque()
        errors[run.name] = None if torque is None else torque["mean_nmse"]
    return errors


def _replay_errors(runs: Sequence[EvaluatedRun], replay: str) -> dict[str, float | None]:
    return {run.name: run.replay_error(replay) for run in runs}


def _torque_tables(runs: Sequence[EvaluatedRun]) -> list[Table]:
    facts = runs[0].facts
    labels = [f"{joint} [{FORCE[kind]}]" for joint, kind in zip(facts.joints, facts.joint_types, strict=True)]
    rows: list[dict[str, float | None]] = [{} for _ in labels]
    same_joints = True
    for run in runs:
        torque = run.torque()
        if torque is None:
            return []
        same_joints &= run.facts.joints == facts.joints
        for row, error in zip(rows, torque["rmse"], strict=False):
            row[run.name] = error
    tables = [table("Torque error, nMSE", ["mean of all"], [_torque_errors(runs)])]
    if same_joints:  # joints of other arms have nothing to be compared with
        tables.append(table("Torque error by joint, RMSE", labels, rows))
    return tables


def _replay_table(runs: Sequence[EvaluatedRun], name: str) -> Table:
    """Return errors of the logs that all runs have replayed, and the mean of each run's own."""
    errors = {run.name: run.errors("replays", name)["trajectories"] for run in runs}
    logs = _in_all(list(errors.values()))
    rows: list[dict[str, float | None]] = []
    for log in logs:
        rows.append({run: 1000 * error[log] for run, error in errors.items()})
    rows.append(_replay_errors(runs, name))
    unit = thousandths(runs[0].facts.joint_types)
    return table(f"Commands replayed, {name}: RMS of positions [{unit}]", [*logs, "mean of all"], rows)


def _growth(runs: Sequence[EvaluatedRun]) -> list[Panel]:
    curves: dict[str, dict[str, tuple[Sequence[float], Record]]] = {measure: {} for measure in ERRORS}
    for run in runs:
        growth = (run.evaluation.get("traces") or {}).get("growth") or {}
        for measure, by_run in curves.items():
            error = growth.get(measure, {}).get(MODEL)
            if error:
                by_run[run.name] = growth["seconds"], error
    return growth_panels(curves, {run.name: run.style for run in runs}, [run.name for run in runs])
