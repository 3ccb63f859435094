"""HTML pages about one run and about several runs. A page names the files that are absent in the run folder."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from jinja2 import TemplateError

from spelgen.emission.text import description
from spelgen.errors import RunError, in_one_line
from spelgen.evaluation.tables import joined, result_tables
from spelgen.evaluation.traces import Traces
from spelgen.files import write_json, write_text
from spelgen.fitting.run_folder import RunFolder
from spelgen.fitting.run_record import Content
from spelgen.fitting.servo.report import servo_summary
from spelgen.labels import MODEL, UNITS, named_joints
from spelgen.render import run_facts
from spelgen.render.arm_section import arm_section, evaluated_motions, matrix
from spelgen.render.parameters import parameter_tables
from spelgen.render.plots import growth_chart
from spelgen.render.report_charts import coverage_panels, evaluation_charts, loss_chart
from spelgen.render.run_facts import Run
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics
from spelgen.structure.structure import derive
from spelgen.templates import render_page

SCHEMA = 1
"""Version of the JSON format of a report."""


def write_report(
    folder: Path | str, output: Path | str | None = None, robot: Path | str | None = None
) -> Path:
    """Write the page about a run; return the path of the page.

    Args:
        folder: Run folder.
        output: File of the page; default: report.html in the run folder. A file with the suffix .json gets the data
            of the page instead.
        robot: URDF with its meshes, for the picture of the arm; default: the URDF in the run folder.

    Raises:
        RunError, ModuleError: The folder is not a run folder, or a file in it cannot be read.
    """
    folder = Path(folder)
    path = Path(output or folder / "report.html")
    # The suffix of the file selects the format, so that no further option is needed.
    if path.suffix == ".json":
        return write_json(path, report_data(folder))
    return write_text(path, render_report(folder, robot))


def report_data(folder: Path | str) -> Content:
    """Return the content of the page about a run as data for programs: assessment, evaluation, parameters.

    Baselines and the posterior are included.
    """
    run = Run(folder)
    tables = parameter_tables(run.model, run.arm, run.baselines, run.posterior)
    bodies = run.model.inertial_parameters.tolist() if isinstance(run.model, RigidBodyDynamics) else None
    return {
        "schema": SCHEMA,
        "verdict": run.results and run.results.assessment and asdict(run.results.assessment),
        "bodies": bodies,
        "tables": list(map(asdict, tables)),
        "posterior": None if run.posterior is None else run.posterior.to_dict(),
        "evaluation": None if run.results is None else run.folder.read_json(run.folder.evaluation),
        "least_squares": run.baselines or None,
    }


def render_report(folder: Path | str, robot: Path | str | None = None) -> str:
    """Return the page about a run as HTML; the same run gives the same text.

    robot: URDF with its meshes, for the picture of the arm; default: the URDF in the run folder.
    """
    # Files of a run folder are untrusted and may have any content, so exceptions of any type are reported as errors.
    try:
        return _rendered(Run(folder), robot)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, TemplateError) as error:
        got = f"files without the data of a report ({in_one_line(error)})"
        raise RunError(got, file=Path(folder), do="run `spelgen evaluate` again") from error


def _rendered(run: Run, robot: Path | str | None) -> str:
    spec, record = run.spec, run.config
    # A run without evaluation gets the same page from empty results: each section then has a note that it is empty.
    traces, tables = Traces({}), []
    if run.results is not None:
        traces, tables = run.results.traces, result_tables(run.results)
    sections = dict.fromkeys(("arm", "cells", "training", "settings", "losses"))
    sections |= evaluation_charts(traces, spec)
    if run.arm is not None:
        urdf = Path(robot or run.arm.robot.path)
        sections["arm"] = arm_section(run.arm.chain, urdf, evaluated_motions(traces))
        sections["cells"] = matrix(run.arm.chain, derive(run.arm.chain, spec.options.assume))
    if record is not None:
        sections["training"] = run_facts.training_facts(run, record)
        sections["settings"] = run_facts.settings(record)
    if run.metrics:
        sections["losses"] = loss_chart(run.metrics, run_facts.best_epoch(run.metrics))
    joints = named_joints(spec.joint_names, spec.joint_types)
    return render_page(
        "report.html.jinja",
        **sections,
        spec=spec,
        about=description(spec),
        units=UNITS,
        outliers=None if run.results is None else run_facts.outlier_note(run.results),
        config=record,
        evaluation=run.results,
        tables=tables,
        coverage=coverage_panels(traces, run.baselines, joints, [joint.limits for joint in spec.joints]),
        trained=run.model is not None,
        under_servos=record is not None and record.mapping.input == "position",
        summary=None if record is None else servo_summary(record.servo),
        parameters=parameter_tables(run.model, run.arm, run.baselines, run.posterior),
        commands=run_facts.commands(run.folder, spec, run.config),
    )


STYLES = ("model", "train", "gravity", "coriolis", "friction", "hold")


def render_runs(folders: Sequence[Path]) -> str:
    """Return the page that compares several evaluated runs, as HTML.

    Raises RunError for a folder without an evaluated run.
    """
    # All runs are read before the page is written, so that an unreadable run does not result in an incomplete page.
    runs = {}
    results = {}
    for name, folder in zip(_names(folders), folders, strict=True):
        RunFolder(folder).read_record()  # the record is read only to check that the folder contains a run
        run = Run(folder)
        if run.results is None:
            raise RunError("a run that is not evaluated", file=folder, do="spelgen evaluate")
        runs[name], results[name] = run, run.results
    errors = {}
    for name, evaluated in results.items():
        growth = evaluated.traces.growth
        if growth is not None:
            errors[name] = growth.seconds, growth.relative[MODEL]
    # Styles are repeated if there are more runs than styles.
    styles = dict(zip(runs, STYLES * len(runs), strict=False))
    return render_page(
        "runs.html.jinja",
        runs=runs,
        robots=sorted({run.spec.robot for run in runs.values()}),
        tables=joined(results),
        growth=growth_chart(errors, styles, runs) if errors else None,
    )


def _names(folders: Sequence[Path]) -> list[str]:
    """Return one name per run folder: the last n parts of its path, with the smallest n that makes all names distinct.

    Whole paths are avoided, since they would disclose the user's home folder.
    """
    # Paths of run folders are resolved, because the path `.` has no name.
    paths = list(map(Path.resolve, folders))
    names = []
    for count in range(1, max(len(path.parts) for path in paths) + 1):
        names = ["/".join(path.parts[-count:]) for path in paths]
        if len(set(names)) == len(names):
            break
    return names
