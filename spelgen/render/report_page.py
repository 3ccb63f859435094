"""A run folder -> one self-contained HTML page. What the folder lacks is said, not guessed."""

from __future__ import annotations

import ast
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from jinja2 import TemplateError

from spelgen.baselines.run_arm import run_arm
from spelgen.errors import RunError, SpelgenError, in_one_line
from spelgen.evaluation.results import Results
from spelgen.evaluation.tables import result_tables
from spelgen.evaluation.traces import Traces
from spelgen.evaluation.verdict import Limits, Verdict, verdict
from spelgen.files import write_json, write_text
from spelgen.fitting.run_folder import RunFolder, trained_model
from spelgen.fitting.servo.report import servo_summary
from spelgen.labels import UNITS, named_joints
from spelgen.listing import Listing
from spelgen.loaded_arm import LoadedArm
from spelgen.render.arm_section import arm_section, matrix
from spelgen.render.curves import curves
from spelgen.render.page import render_page
from spelgen.render.parameters import body_parameters, parameter_tables
from spelgen.render.plots import Record, coverage_panels
from spelgen.render.run_facts import commands, files, head_numbers, training_facts
from spelgen.spec import Facts, read_facts

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

SCHEMA = 1
"""Of the page as data."""


class Run:
    """Read what a run folder holds, each file when it is first needed; None stands for what the folder lacks."""

    def __init__(self, folder: Path | str) -> None:
        self.folder = RunFolder(folder)

    @cached_property
    def facts(self) -> Facts:
        """Return the facts of the run's module."""
        return read_facts(self.folder.module)

    @cached_property
    def config(self) -> Record | None:
        """Return how the run was trained."""
        return self.folder.read_config() if self.folder.config.is_file() else None

    @cached_property
    def results(self) -> Results | None:
        """Return the evaluation."""
        record = self.record(self.folder.evaluation)
        return None if record is None else Results.from_dict(record)

    @cached_property
    def identified(self) -> Record | None:
        """Return what least squares found."""
        return self.record(self.folder.baseline)

    @cached_property
    def arm(self) -> LoadedArm | None:
        """Return the arm; None also where its URDF is one that this version refuses: the page stands without."""
        try:
            return run_arm(self.folder)
        except SpelgenError:
            return None

    @cached_property
    def model(self) -> EmittedModel | None:
        """Return the trained model."""
        return trained_model(self.folder) if self.folder.weights.is_file() else None

    def record(self, path: Path) -> Record | None:
        """Return what a file of JSON holds."""
        return self.folder.read_json(path) if path.is_file() else None

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
    run = Run(folder)
    data: dict[str, object] = {"schema": SCHEMA, "verdict": None, "bodies": None}
    if run.verdict is not None:
        data["verdict"] = asdict(run.verdict)
    if run.model is not None:
        bodies = body_parameters(run.model)
        if bodies is not None:
            data["bodies"] = bodies.tolist()
    data["tables"] = list(map(asdict, run.parameters))
    return data | {"evaluation": run.record(run.folder.evaluation), "least_squares": run.identified}


def render_report(folder: Path | str, robot: Path | str | None = None) -> str:
    """Return the page about a run as HTML; the same folder gives the same text. robot: see ``write_report``."""
    run = Run(folder)
    if not run.folder.module.is_file():
        raise RunError(
            "no run",
            file=run.folder.path,
            expected="a folder with module.py",
            do="make one with `spelgen train`",
        )
    # files of a run folder may come from anywhere and hold anything
    try:
        return _rendered(run, robot)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, TemplateError) as error:
        raise RunError(
            f"files without the data of a report ({in_one_line(error)})",
            file=run.folder.path,
            do="run `spelgen evaluate` again",
        ) from error


def _rendered(run: Run, robot: Path | str | None) -> str:
    facts, config, metrics = run.facts, run.config or {}, run.folder.read_metrics()
    traces = Traces({}) if run.results is None else run.results.traces
    arm, cells, training, tables = None, None, None, []
    joints = named_joints(facts.joints, facts.joint_types)
    if config:
        training = training_facts(config, metrics, run.identified, run.model)
    if run.results is not None:
        tables = result_tables(run.results)
    if run.arm is not None:
        arm = arm_section(run.arm.arm, Path(robot or run.arm.robot.path), traces, run.identified)
        cells = matrix(run.arm.arm, run.arm.structure_for(facts.options.assume))
    # the sentences about the model
    docstring = ast.get_docstring(ast.parse(run.folder.module.read_bytes())) or ""
    return render_page(
        "report.html.jinja",
        facts=facts,
        about=" ".join(docstring.split("\n\n")[1].split()),
        cells=cells,
        arm=arm,
        units=UNITS,
        numbers=head_numbers(run.model, config, metrics, run.results),
        verdict=run.verdict,
        config=run.config,
        training=training,
        evaluation=run.results,
        tables=tables,
        curves=curves(traces, facts),
        coverage=coverage_panels(traces, run.identified, joints, run.limits),
        trained=run.model is not None,
        under_servos=config.get("mapping", {}).get("input") == "position",
        summary=servo_summary(config),
        parameters=run.parameters,
        files=files(run.folder.path),
        commands=commands(run.folder, facts, run.config),
    )
