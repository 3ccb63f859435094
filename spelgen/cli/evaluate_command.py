"""Commands about trained runs: `evaluate` and `estimate` along logs, `report`, and `compare` for many runs."""

from __future__ import annotations

import json
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Literal

import typer

from spelgen.cli import options
from spelgen.cli.console import FAILED, answer, note, progress_bar, say
from spelgen.cli.options import UsageError, argument, flag, option, output_option
from spelgen.evaluation.tables import LIMITS, limit_figures, summary
from spelgen.files import write_json
from spelgen.listing import WIDTH

if TYPE_CHECKING:
    from spelgen.comparison.arms import Comparison


LIMIT_EXCEEDED = 3  # Exit code if an error exceeds --limit. Code 2 is used by usage errors.
LIMIT_HELP = f"Exit with {LIMIT_EXCEEDED} if a figure is larger: {', '.join(LIMITS)}; once for each."


def evaluate(
    run: Path = options.RUN,
    extra_logs: list[Path] | None = options.MORE_DATA,
    data: list[Path] | None = options.DATA,
    mapping: Path | None = options.MAPPING_FILE,
    filter: float | None = options.FILTER,
    format: Literal["text", "json"] | None = options.result_format(),
    output: Path | None = options.OUTPUT,
    limit: list[str] | None = option("FIGURE=MAX", LIMIT_HELP),
    truth: Path | None = option("URDF", "The true arm of simulated logs: state the error of M(q)."),
    quick: bool = flag("--quick", "Torque errors only, without rollouts."),
) -> None:
    """Evaluate a trained run and its baselines on test logs.

    The result begins with an assessment of the model. The result is also written to evaluation.json in the run folder,
    and no other file is changed.
    """
    # Options --limit are checked first, so that a misspelt name is reported before minutes of rollouts.
    paths = options.logs(data, extra_logs)
    limits = list(map(_limit, limit or []))
    from spelgen.evaluation.evaluate import SECONDS, STEPS, read_test_logs
    from spelgen.evaluation.evaluate import evaluate as evaluate_model
    from spelgen.fitting.run_folder import RunFolder
    from spelgen.logs.preprocessing import Preprocessing

    # The logs are read before the run is loaded: errors in logs are frequent, and are reported without delay.
    logs = read_test_logs(run, paths, mapping)
    with progress_bar("evaluating") as progress:
        results = evaluate_model(
            run,
            logs,
            preprocessing=None if filter is None else Preprocessing(cutoff=filter),
            steps=() if quick else STEPS,
            seconds=() if quick else SECONDS,
            truth=truth,
            progress=progress,
        )
    record = results.to_dict()
    # evaluation.json is written before anything is printed, so that a closed pipe does not lose the result.
    write_json(RunFolder(run).evaluation, record)
    # Diagnostics go to stderr, because scripts read the result from stdout.
    for diagnostic in results.diagnostics:
        note(diagnostic)
    options.write_result(format, output, {"text": results.text, "json": lambda: json.dumps(record)})
    # Limits are tested after the result is printed: a script gets the result even if an error exceeds its limit.
    values = limit_figures(results)
    exceeded = []
    for name, limit_value in limits:
        value = values[name]
        if value is None or value > limit_value:
            text = "not known" if value is None else f"{value:.4g}"
            exceeded.append(f"limit exceeded: {name} is {text}, expected at most {limit_value:g}")
    if exceeded:
        note("\n".join(exceeded))
        raise typer.Exit(LIMIT_EXCEEDED)


def _limit(text: str) -> tuple[str, float]:
    """Return a text such as `torque.nmse=0.01` as a name and a number. Raises a usage error for any other text."""
    name, _, value = text.partition("=")
    try:
        if name in LIMITS:
            return name, float(value)
    except ValueError:
        pass
    message = f"{text!r} is not FIGURE=MAX with one of {', '.join(LIMITS)}"
    raise typer.BadParameter(message, param_hint="'--limit'")


def estimate(
    run: Path = options.RUN,
    extra_logs: list[Path] | None = options.MORE_DATA,
    data: list[Path] | None = options.DATA,
    mapping: Path | None = options.MAPPING_FILE,
    accept: list[str] | None = options.ACCEPT,
    alarms: float | None = option("RATE", "False alarms of contact per minute; default: 1.", min=1e-6),
    output: Path | None = output_option("FILE", "HTML page; default: estimate.html in the run folder."),
    format: options.TextOrJson = options.TEXT_OR_JSON,
) -> None:
    """Run the estimator along logs: payload, contacts, friction drift.

    It prints mass and centre of mass with 95 % intervals, contacts with times and torques, and the friction of each
    joint relative to the model, and writes a page with their curves.
    """
    paths = options.logs(data, extra_logs)
    from spelgen.fitting.fitted import load_run
    from spelgen.labels import torque_units, torques_text
    from spelgen.live.estimator import torque_model
    from spelgen.live.levels import noise_levels
    from spelgen.live.replay import replay
    from spelgen.live.tuning import TUNING
    from spelgen.logs.read import read_logs
    from spelgen.render.estimate_page import write_estimate

    path = output or Path(run) / "estimate.html"
    options.choose_format(None, path, ["html"])
    fit = load_run(run)
    # The estimator needs predicted torques. A model of position servos predicts no torques: `torque_model` then raises
    # an error, before logs are read.
    torque_model(fit)
    levels = noise_levels(fit)
    joints = list(fit.model.joint_names)
    log_mapping = options.log_mapping(joints, mapping or fit.record.mapping, accept)
    results = replay(fit, read_logs(paths, joints, mapping=log_mapping), alarms)
    page = write_estimate(fit, levels, results, path)
    alarm_rate, rate = alarms or TUNING.alarms_per_minute, levels.supported_alarms
    thresholds = dict(zip(joints, levels.contact_thresholds(alarm_rate).tolist(), strict=True))
    record = {
        "run": str(run), "page": str(page), "supported_alarms_per_minute": rate,
        "logs": [result.to_dict() for result in results], "contact_thresholds": thresholds,
    }  # fmt: skip
    smallest = torques_text(
        {joint: f"{moving:.3g}; {resting:.3g}" for joint, (moving, resting) in thresholds.items()},
        torque_units(joints, fit.model.joint_types),
    )
    supported = (
        f"contact thresholds in motion; at rest: {smallest}, for a rate "
        f"of false alarms of {alarm_rate:g} per minute (training logs support >= {rate:.2g})"
    )
    if alarm_rate < rate:
        supported += ": the training logs are too short for this rate, train with longer logs"
    texts = [*(result.text() for result in results), fill(supported, WIDTH, subsequent_indent="    ")]
    answer(format, record, *texts, f"wrote {page}")


def report(
    run: Path = options.RUN,
    output: Path | None = output_option("FILE", "HTML file; default: report.html in the run folder."),
    robot: Path | None = option("ROBOT.urdf", "URDF with its meshes, for the picture of the arm."),
) -> None:
    """Write an HTML page about a run."""
    options.choose_format(None, output, ["html"])
    from spelgen.evaluation.results import Results
    from spelgen.fitting.run_folder import RunFolder
    from spelgen.render.report_page import write_report

    path, folder = write_report(run, output, robot), RunFolder(run)
    if folder.evaluation.exists():
        listing = summary(Results.from_dict(folder.read_json(folder.evaluation)))
        if listing is not None:
            say(listing.text() + "\n")
    say(f"wrote {path}: the report, for any browser")


def compare(
    target: Path = argument("TARGET", "URDF of an arm, or YAML file that lists arms and their logs."),
    extra_logs: list[Path] | None = options.MORE_DATA,
    data: list[Path] | None = options.DATA,
    mapping: Path | None = options.MAPPING_FILE,
    output: Path | None = output_option("FOLDER", "Output folder; default: comparisons/TARGET."),
    presets: str | None = option(
        "A,B,C", "Presets or YAML files of designs; default: closed-form,hybrid on logs, else all presets."
    ),
    seeds: int | None = option("", "Number of runs of each preset.", min=1),
    splits: int | None = option("", "Folds of a cross-validation over trajectories; default: 1.", min=1),
    steps: int | None = option("", "Training steps of each run on a simulated arm.", min=1),
    jobs: int | None = option(
        "", "Number of parallel runs, one core each, by Ray; default: all cores if Ray is installed.", min=1
    ),
    address: str | None = options.ADDRESS,
) -> None:
    """Train presets on the same logs and rank them.

    An arm without logs is simulated by the protocol of its settings. The same command resumes an interrupted
    comparison, and reruns only changed runs.
    """
    from spelgen.comparison.study import prepare_study, run_study
    from spelgen.comparison.tables import arm_sections
    from spelgen.fitting.process import locked, termination_as_interrupt
    from spelgen.render.comparison_page import write_comparison
    from spelgen.tasks import default_jobs

    paths = options.logs(data, extra_logs) if data or extra_logs else []
    names = options.names(presets)
    values = {
        "presets": names and tuple(names),
        "seeds": seeds, "splits": splits, "steps": steps,
    }  # fmt: skip
    # Options on the command line replace the values in the file of the comparison.
    changes = {name: value for name, value in values.items() if value is not None}
    comparison = _comparison(target, paths, mapping).model_copy(update=changes)
    name = f"{target.stem}-logs" if paths else target.stem
    # The path of the output folder must be absolute, since workers have other working directories.
    folder = (output or Path("comparisons") / name).absolute()
    # All cores are used by default, because a comparison takes hours on one core.
    parallel = jobs or default_jobs()
    # The output folder is locked: two simultaneous comparisons would overwrite each other's runs.
    with locked(folder), termination_as_interrupt():
        with progress_bar("simulating") as progress:
            study = prepare_study(comparison, folder, progress)
        note(study.announcement(parallel))
        # The inputs of all runs are written before the workers start, so that all workers read the same files.
        study = run_study(study, note, parallel, address)
        sections = arm_sections(study)
        # Tables are printed in addition to the page, which cannot be shown in a terminal.
        for section in sections:
            say(fill(f"{section.name}: {section.sentence}", WIDTH, break_on_hyphens=False) + "\n")
            for table in section.tables:
                say(f"{table.text()}\n")
        say(f"wrote {write_comparison(study, sections)}")
    # The page lists the failed runs, so it is written before the command exits with an error.
    if study.failures:
        raise typer.Exit(FAILED)


def _comparison(target: Path, logs: list[Path], mapping: Path | None) -> Comparison:
    """Return the comparison of presets on the arm of the URDF `target`, or as specified by the YAML file `target`.

    logs, mapping: logs of the arm of the URDF, and mapping of their columns. UsageError if they are given with a YAML
    file.
    """
    from spelgen.comparison.arms import YAML, ComparedArm, Comparison, load_comparison

    if target.suffix not in YAML:
        data = tuple(path.absolute() for path in logs)
        arm = ComparedArm(urdf=target.absolute(), data=data, mapping=mapping and mapping.absolute())
        return Comparison.model_construct(arms={target.stem: arm})
    if logs or mapping:
        raise UsageError("--data and --mapping: belong to a URDF; in a YAML file each arm has its own")
    return load_comparison(target.absolute())
