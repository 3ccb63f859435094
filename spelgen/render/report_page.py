"""HTML page about one run. The page states which files are absent in the run folder."""

from contextlib import suppress
from pathlib import Path

from jinja2 import TemplateError

from spelgen.emission.specify import arm_of_spec
from spelgen.emission.text import description
from spelgen.errors import RunError, SpelgenError, in_one_line
from spelgen.evaluation.results import Results
from spelgen.evaluation.tables import result_tables
from spelgen.evaluation.traces import Traces
from spelgen.files import write_text
from spelgen.fitting.fitted import Fit, load_run
from spelgen.fitting.run_folder import RunFolder
from spelgen.fitting.servo.report import servo_summary
from spelgen.labels import UNITS, named_joints
from spelgen.render import run_facts
from spelgen.render.arm_section import arm_section, evaluated_motions, matrix
from spelgen.render.parameters import parameter_tables
from spelgen.render.report_charts import coverage_panels, evaluation_charts, loss_chart
from spelgen.structure.structure import derive
from spelgen.templates import render_page


def write_report(
    folder: Path | str, output: Path | str | None = None, robot: Path | str | None = None
) -> Path:
    """Write the page about a run; return the path of the page.

    Args:
        folder: Run folder.
        output: File of the page; default: report.html in the run folder.
        robot: URDF with its meshes, for the picture of the arm; default: the URDF in the run folder.

    Raises:
        RunError, ModuleError: The folder is not a run folder, or a file in it cannot be read.
    """
    return write_text(output or Path(folder) / "report.html", render_report(folder, robot))


def render_report(folder: Path | str, robot: Path | str | None = None) -> str:
    """Return the page about a run as HTML; the same run gives the same text.

    robot: URDF with its meshes, for the picture of the arm; default: the URDF in the run folder.
    """
    # Files of a run folder are untrusted and may have any content, so exceptions of any type are reported as errors.
    try:
        return _rendered(load_run(folder), RunFolder(folder), robot)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, TemplateError) as error:
        got = f"files without the data of a report ({in_one_line(error)})"
        raise RunError(got, file=Path(folder), do="run `spelgen evaluate` again") from error


def _rendered(fit: Fit, run: RunFolder, robot: Path | str | None) -> str:
    spec, record = fit.model.spec, fit.record
    # A run without evaluation gets the same page from empty results: each section then has a note that it is empty.
    results, traces = None, Traces({})
    if run.evaluation.is_file():
        results = Results.from_dict(run.read_json(run.evaluation))
        traces = results.traces
    arm = picture = cells = losses = None
    if fit.urdf is not None:
        # An unreadable URDF is no error: results do not depend on it, only the picture of the arm is omitted.
        with suppress(SpelgenError):
            arm = arm_of_spec(spec, fit.urdf)
    if arm is not None:
        picture = arm_section(arm.chain, Path(robot or arm.robot.path), evaluated_motions(traces))
        cells = matrix(arm.chain, derive(arm.chain, spec.options.assume))
    if fit.history:
        losses = loss_chart(fit.history, fit.checkpoint.best_epoch)
    posterior = fit.posterior if fit.checkpoint.posterior is not None else None
    joints = named_joints(spec.joint_names, spec.joint_types)
    return render_page(
        "report.html.jinja",
        **evaluation_charts(traces, spec),
        arm=picture,
        cells=cells,
        training=run_facts.training_facts(fit),
        losses=losses,
        spec=spec,
        about=description(spec),
        units=UNITS,
        outliers=results and run_facts.outlier_note(results),
        config=record,
        evaluation=results,
        tables=results and result_tables(results),
        coverage=coverage_panels(traces, fit.baselines, joints, [joint.limits for joint in spec.joints]),
        under_servos=record.mapping.input == "position",
        summary=servo_summary(record.servo),
        parameters=parameter_tables(fit.model, arm, fit.baselines, posterior),
        commands=run_facts.commands(run, spec, record),
    )
