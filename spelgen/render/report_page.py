"""A run folder -> one self-contained HTML page. What the folder lacks is said, not guessed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from spelgen.errors import RunError, SpelgenError
from spelgen.evaluation.names import MODEL
from spelgen.evaluation.tables import result_tables
from spelgen.files import write_json, write_text
from spelgen.fitting.run_folder import RunFolder, trained_model
from spelgen.identification.baseline import run_arm
from spelgen.labels import entry_name
from spelgen.listing import number
from spelgen.loaded_arm import LoadedArm
from spelgen.logs.preprocessing import Preprocessing
from spelgen.render.arm_section import LETTERS, ArmSection, Cell, arm_section, matrix
from spelgen.render.learned import Learned, read_learned
from spelgen.render.page import render_page
from spelgen.render.parameters import ParameterTable, body_parameters, parameter_tables
from spelgen.render.picture import Picture, read_picture
from spelgen.render.plots import (
    FORCE,
    UNITS,
    Panel,
    coverage_panels,
    eigenvalue_chart,
    energy_chart,
    friction_panels,
    growth_charts,
    loss_chart,
    mass_panels,
    style,
    torque_panels,
    trajectory_panels,
)
from spelgen.render.reproduction import commands, files
from spelgen.render.verdict import verdict
from spelgen.spec import Facts, read_facts

SCHEMA = 1  # of the page as data
Limits = list[tuple[float, float] | None]


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


@dataclass(frozen=True)
class Drawn:
    """A part of the page: a heading, its legend (style, label) and panels."""

    title: str
    key: tuple[tuple[str, str], ...]
    panels: tuple[Panel, ...]


@dataclass(frozen=True)
class Curves:
    """All that is drawn of an evaluation's traces; None or empty where there is nothing."""

    growth: tuple[Panel, ...] = ()
    torques: tuple[Drawn, ...] = ()
    trajectories: tuple[Drawn, ...] = ()
    mass: tuple[Panel, ...] = ()
    eigenvalues: Markup | None = None
    along: str = ""
    friction: tuple[Panel, ...] = ()
    energy: Markup | None = None


def write_report(
    folder: Path | str, output: Path | str | None = None, robot: Path | str | None = None
) -> Path:
    """Write the page about a run, by default as report.html in its folder; return its path.

    A name that ends with .json: the same as data. robot: the run's URDF where its meshes lie beside it.

    Raises RunError or ModuleError when the folder is no run, or a file of it cannot be read.
    """
    folder = Path(folder)
    path = Path(output) if output else folder / "report.html"
    if path.suffix == ".json":
        return write_json(path, report_data(folder))
    return write_text(path, render_report(folder, robot))


def report_data(folder: Path | str) -> dict[str, Any]:
    """All that the page shows, for programs: the verdict, the evaluation, least squares, the model's parameters."""
    run = RunFolder(Path(folder))
    evaluation, identified = (
        run.read_json(path) if path.is_file() else None for path in (run.evaluation, run.baseline)
    )
    arm, trained = _arm(run), trained_model(run) if run.weights.is_file() else None
    limits = _limits(arm, len(read_facts(run.module).joints))
    bodies = None if trained is None else body_parameters(trained)
    return {
        "schema": SCHEMA,
        "verdict": asdict(verdict(evaluation, identified, limits)) if evaluation else None,
        "evaluation": evaluation,
        "least_squares": identified,
        "bodies": None if bodies is None else bodies.tolist(),
        "tables": [asdict(table) for table in _parameters(trained, arm, identified)],
    }


def render_report(folder: Path | str, robot: Path | str | None = None) -> str:
    """The page about a run as HTML; the same folder gives the same text. robot: see ``write_report``."""
    run = RunFolder(Path(folder))
    if not run.module.is_file():
        raise RunError(
            "no run", file=run.path, expected="a folder with module.py", do="make one with `spelgen train`"
        )
    facts, picture = read_facts(run.module), read_picture(run.module)
    config = run.read_config() if run.config.is_file() else None
    evaluation, identified = (
        run.read_json(path) if path.is_file() else None for path in (run.evaluation, run.baseline)
    )
    metrics = run.read_metrics()
    arm = _arm(run)
    trained = trained_model(run) if run.weights.is_file() else None
    traces = (evaluation or {}).get("traces") or {}
    limits = _limits(arm, len(facts.joints))
    learned = read_learned(run) if trained is not None else None
    return render_page(
        "report.html.jinja",
        facts=facts,
        picture=picture,
        cells=_cells(arm, facts, picture),
        arm=_section(arm, traces, identified, robot),
        units=UNITS,
        force=FORCE,
        numbers=_numbers(learned, config, metrics, evaluation),
        verdict=verdict(evaluation, identified, limits) if evaluation else None,
        config=config,
        training=_training(config, metrics, identified) if config else None,
        evaluation=evaluation,
        predictors=_predictors(evaluation),
        tables=result_tables(evaluation, facts.joint_types) if evaluation else [],
        curves=_curves(traces, facts, picture),
        coverage=_coverage(traces, identified, facts, limits),
        learned=learned,
        parameters=_parameters(trained, arm, identified),
        files=files(run.path),
        commands=commands(run, facts, config),
    )


def _arm(run: RunFolder) -> LoadedArm | None:
    """The run's arm, where its folder has the URDF and that can still be read."""
    try:
        return run_arm(run)
    except SpelgenError:
        return None


def _section(
    arm: LoadedArm | None,
    traces: Mapping[str, Any],
    identified: Mapping[str, Any] | None,
    robot: Path | str | None,
) -> ArmSection | None:
    if arm is None:
        return None
    return arm_section(arm.arm, Path(robot) if robot else arm.robot.path, traces, identified)


def _parameters(
    model: Any | None, arm: LoadedArm | None, identified: Mapping[str, Any] | None
) -> list[ParameterTable]:
    return parameter_tables(model, arm, identified)


def _cells(arm: LoadedArm | None, facts: Facts, picture: Picture) -> list[list[Cell]]:
    """M with reasons where the model's structure is the arm's own, else as the module's docstring pictures it."""
    if arm is not None:
        derived = matrix(arm.arm, arm.structure_for(facts.options.assume))
        if [[x.kind for x in row] for row in derived] == [[x.kind for x in row] for row in picture.rows]:
            return derived
    return [
        [
            Cell(x.kind, LETTERS.get(x.kind, x.joints), (), f"{entry_name(max(i, j), min(i, j))}: {x.kind}")
            for j, x in enumerate(row)
        ]
        for i, row in enumerate(picture.rows)
    ]


def _limits(arm: LoadedArm | None, count: int) -> Limits:
    if arm is None:
        return [None] * count
    return [
        None if x.continuous or x.lower is None or x.upper is None else (x.lower, x.upper)
        for x in arm.arm.coordinates
    ]


def _predictors(evaluation: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    """Legend of all that predicts: style and name."""
    horizons = (evaluation or {}).get("horizons") or []
    names = list(horizons[0]["errors"]) if horizons else list((evaluation or {}).get("torque") or {})
    return [(style(name), name) for name in names]


def _curves(traces: Mapping[str, Any], facts: Facts, picture: Picture) -> Curves:
    joints, types = facts.joints, facts.joint_types
    mass = traces.get("mass") or {}
    torques = traces.get("torques") or []
    both = (("truth", "measured"), ("predicted", "predicted"))
    parts = (
        ("inertia", "inertia"),
        ("coriolis", "Coriolis"),
        ("gravity", "gravity"),
        ("friction", "friction"),
    )
    return Curves(
        growth=tuple(growth_charts(traces["growth"])) if traces.get("growth") else (),
        torques=tuple(
            Drawn(
                f"{x['which'].capitalize()} trajectory: {x['trajectory']}",
                (*both, *parts),
                tuple(torque_panels(x, joints, types)),
            )
            for x in torques
        ),
        trajectories=tuple(
            Drawn(
                f"{x['which'].capitalize()} prediction: {x['trajectory']} from {x['start']:g} s, "
                f"relative error {number(x['error'])}",
                both,
                tuple(trajectory_panels(x, joints, types)),
            )
            for x in traces.get("trajectories", [])
        ),
        mass=tuple(mass_panels(mass, types, picture.rows)) if mass.get("by") else (),
        eigenvalues=eigenvalue_chart(mass) if mass.get("by") else None,
        along=str(mass.get("trajectory", "")),
        friction=tuple(friction_panels(traces["friction"], torques, joints, types))
        if traces.get("friction")
        else (),
        energy=energy_chart(torques[0]) if torques else None,
    )


def _coverage(
    traces: Mapping[str, Any], identified: Mapping[str, Any] | None, facts: Facts, limits: Limits
) -> list[Panel]:
    known = {"training": (identified or {}).get("coverage"), "test": traces.get("coverage")}
    logs = {name: x for name, x in known.items() if x}
    return coverage_panels(logs, facts.joints, facts.joint_types, limits) if logs else []


def _numbers(
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
    if learned:
        found.append(Number(f"{learned.parameters:,}", "trained parameters"))
    if metrics:
        found.append(Number(_duration(metrics[-1]["seconds"]), f"of training, {metrics[-1]['step']:,} steps"))
    return found


def _training(
    config: Mapping[str, Any], metrics: Sequence[Mapping[str, Any]], identified: Mapping[str, Any] | None
) -> Training:
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
