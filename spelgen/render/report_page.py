"""A run folder -> one self-contained HTML page. What the folder lacks is said, not guessed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from jinja2 import TemplateError

from spelgen.baselines.run_arm import run_arm
from spelgen.errors import RunError, SpelgenError
from spelgen.evaluation.results import Results
from spelgen.evaluation.tables import result_tables
from spelgen.evaluation.verdict import verdict
from spelgen.files import write_json, write_text
from spelgen.fitting.run_folder import RunFolder, trained_model
from spelgen.labels import entry_name
from spelgen.loaded_arm import LoadedArm
from spelgen.render.arm_section import LETTERS, ArmSection, Cell, arm_section, matrix
from spelgen.render.curves import Limits, coverage, curves, predictors
from spelgen.render.learned import read_learned
from spelgen.render.page import render_page
from spelgen.render.parameters import ParameterTable, body_parameters, parameter_tables, servo_table
from spelgen.render.picture import Picture, read_picture
from spelgen.render.plots import FORCE, UNITS
from spelgen.render.reproduction import commands, files
from spelgen.render.run_facts import head_numbers, training_facts
from spelgen.spec import Facts, read_facts

SCHEMA = 1  # of the page as data


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
        "verdict": asdict(verdict(Results.from_dict(evaluation), identified, limits)) if evaluation else None,
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
    try:
        return _rendered(run, robot)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, TemplateError) as error:
        raise RunError(
            f"files that do not hold what a report needs ({type(error).__name__}: {error})", file=run.path,
            do="run `spelgen evaluate` again",
        ) from error  # fmt: skip


def _rendered(run: RunFolder, robot: Path | str | None) -> str:
    facts, picture = read_facts(run.module), read_picture(run.module)
    config = run.read_config() if run.config.is_file() else None
    evaluation, identified = (
        run.read_json(path) if path.is_file() else None for path in (run.evaluation, run.baseline)
    )
    results = Results.from_dict(evaluation) if evaluation else None
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
        numbers=head_numbers(learned, config, metrics, evaluation),
        verdict=verdict(results, identified, limits) if results else None,
        config=config,
        training=training_facts(config, metrics, identified) if config else None,
        evaluation=evaluation,
        predictors=predictors(evaluation),
        tables=result_tables(results) if results else [],
        curves=curves(traces, facts, picture),
        coverage=coverage(traces, identified, facts, limits),
        learned=learned,
        under_servos=config is not None and config["objective"] == "servo",
        servos=servo_table(config["servo"]) if config and "servo" in config else None,
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
