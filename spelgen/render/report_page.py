"""A run folder -> one self-contained HTML page. What the folder lacks is said, not guessed."""

from __future__ import annotations

import ast
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from jinja2 import TemplateError

from spelgen.baselines.run_arm import run_arm
from spelgen.errors import RunError, SpelgenError
from spelgen.evaluation.results import Results
from spelgen.evaluation.tables import result_tables
from spelgen.evaluation.traces import Traces
from spelgen.evaluation.verdict import Limits, Verdict, verdict
from spelgen.files import write_json, write_text
from spelgen.fitting.objectives import fit_summary
from spelgen.fitting.run_folder import RunFolder, trained_model
from spelgen.labels import UNITS
from spelgen.listing import Listing
from spelgen.loaded_arm import LoadedArm
from spelgen.render.arm_section import arm_section, matrix
from spelgen.render.curves import coverage, curves
from spelgen.render.page import render_page
from spelgen.render.parameters import body_parameters, parameter_tables
from spelgen.render.plots import Record
from spelgen.render.reproduction import commands, files
from spelgen.render.run_facts import head_numbers, training_facts
from spelgen.spec import Facts, read_facts

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

SCHEMA = 1
"""Of the page as data."""


@dataclass(frozen=True)
class Run:
    """What a run folder holds; None for what it lacks. arm: None also where its URDF can no longer be read."""

    folder: RunFolder
    facts: Facts
    config: Record | None
    metrics: Sequence[Record]
    results: Results | None
    identified: Record | None
    arm: LoadedArm | None
    model: EmittedModel | None

    @property
    def limits(self) -> Limits:
        """Return the joints' limits, None of a joint without."""
        if self.arm is None:
            return [None] * len(self.facts.joints)
        return [joint.limits for joint in self.arm.arm.coordinates]

    @property
    def parameters(self) -> list[Listing]:
        """Return the tables of what is learned that is a number."""
        return parameter_tables(self.folder, self.model, self.arm, self.identified)

    @property
    def verdict(self) -> Verdict | None:
        """Return what the model is good for; None before it is evaluated."""
        if self.results is None:
            return None
        return verdict(self.results, self.identified, self.limits)


def write_report(
    folder: Path | str, output: Path | str | None = None, robot: Path | str | None = None
) -> Path:
    """Write the page about a run, by default as report.html in its folder; return its path.

    A name that ends with .json: the same as data. robot: the run's URDF where its meshes lie beside it.

    Raises RunError or ModuleError when the folder is no run, or a file of it cannot be read.
    """
    folder = Path(folder)
    path = Path(output or folder / "report.html")
    if path.suffix == ".json":
        return write_json(path, report_data(folder))
    return write_text(path, render_report(folder, robot))


def report_data(folder: Path | str) -> Record:
    """Return all that the page shows, for programs: the verdict, the evaluation, least squares, the parameters."""
    run = _read(RunFolder(Path(folder)))
    data: dict[str, object] = {"schema": SCHEMA, "verdict": None, "bodies": None}
    if run.verdict is not None:
        data["verdict"] = asdict(run.verdict)
    if run.model is not None:
        bodies = body_parameters(run.model)
        if bodies is not None:
            data["bodies"] = bodies.tolist()
    data["tables"] = list(map(asdict, run.parameters))
    evaluation = _json(run.folder, run.folder.evaluation)
    return data | {"evaluation": evaluation, "least_squares": run.identified}


def render_report(folder: Path | str, robot: Path | str | None = None) -> str:
    """Return the page about a run as HTML; the same folder gives the same text. robot: see ``write_report``."""
    run = RunFolder(Path(folder))
    if not run.module.is_file():
        raise RunError(
            "no run", file=run.path, expected="a folder with module.py", do="make one with `spelgen train`"
        )
    # files of a run folder may come from anywhere and hold anything
    try:
        return _rendered(_read(run), robot)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, TemplateError) as error:
        raise RunError(
            f"files without the data of a report ({type(error).__name__}: {error})",
            file=run.path,
            do="run `spelgen evaluate` again",
        ) from error


def _read(folder: RunFolder) -> Run:
    # the page stands without a URDF: a run may have none, or one that this version refuses
    try:
        arm = run_arm(folder)
    except SpelgenError:
        arm = None
    evaluation = _json(folder, folder.evaluation)
    return Run(
        folder,
        read_facts(folder.module),
        config=folder.read_config() if folder.config.is_file() else None,
        metrics=folder.read_metrics(),
        results=None if evaluation is None else Results.from_dict(evaluation),
        identified=_json(folder, folder.baseline),
        arm=arm,
        model=trained_model(folder) if folder.weights.is_file() else None,
    )


def _json(folder: RunFolder, path: Path) -> Record | None:
    if not path.is_file():
        return None
    record: Record = folder.read_json(path)
    return record


def _rendered(run: Run, robot: Path | str | None) -> str:
    facts, config = run.facts, run.config or {}
    traces = Traces({}) if run.results is None else run.results.traces
    arm, cells, training, tables = None, None, None, []
    if config:
        training = training_facts(config, run.metrics, run.identified, run.model)
    if run.results is not None:
        tables = result_tables(run.results)
    if run.arm is not None:
        arm = arm_section(run.arm.arm, Path(robot or run.arm.robot.path), traces, run.identified)
        cells = matrix(run.arm.arm, run.arm.structure_for(facts.options.assume))
    return render_page(
        "report.html.jinja",
        facts=facts,
        about=_about(run.folder.module),
        cells=cells,
        arm=arm,
        units=UNITS,
        numbers=head_numbers(run.model, config, run.metrics, run.results),
        verdict=run.verdict,
        config=run.config,
        training=training,
        evaluation=run.results,
        tables=tables,
        curves=curves(traces, facts),
        coverage=coverage(traces, run.identified, facts, run.limits),
        trained=run.model is not None,
        under_servos=config.get("mapping", {}).get("input") == "position",
        summary=fit_summary(config),
        parameters=run.parameters,
        files=files(run.folder.path),
        commands=commands(run.folder, facts, run.config),
    )


def _about(module: Path) -> str:
    """Return the sentences about the model in the docstring of its module."""
    docstring = ast.get_docstring(ast.parse(module.read_bytes())) or ""
    return " ".join(docstring.split("\n\n")[1].split())
