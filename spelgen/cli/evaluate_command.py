"""Commands about trained runs: `evaluate`, how good one is, and `report`, all about it on a page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Literal

import typer

from spelgen.cli import options
from spelgen.cli.console import deliver, note_diagnostic, say
from spelgen.cli.options import Data, Filter, Mapping, MoreData, Output, Run, Trust

Format = Literal["text", "json", "csv"]


def evaluate(
    run: Run,
    extra_logs: MoreData = None,
    data: Data = None,
    mapping: Mapping = None,
    filter: Filter = None,
    format: Annotated[Format | None, options.result_format()] = None,
    output: Output = None,
    trust: Trust = False,
) -> None:
    """Evaluate a trained run and its baselines on test logs.

    The result is also written to evaluation.json in the run folder.
    """
    paths = options.logs(data, extra_logs)
    import torch

    from spelgen.evaluation.evaluate import evaluate as evaluate_model
    from spelgen.evaluation.subject import read_test_logs
    from spelgen.files import write_json
    from spelgen.fitting.fitted import load_run
    from spelgen.fitting.run_folder import RunFolder
    from spelgen.logs.preprocessing import Preprocessing

    torch.set_num_threads(1)  # matrices are tiny: threads would cost more than they gain
    preprocessing = None
    if filter is not None:
        preprocessing = Preprocessing(cutoff=filter)
    logs = read_test_logs(run, paths, mapping)
    model = load_run(run, trust=trust)
    results = evaluate_model(model, logs, preprocessing=preprocessing)
    record = results.to_dict()
    write_json(RunFolder(run).evaluation, record)
    for diagnostic in results.diagnostics:
        note_diagnostic(diagnostic)
    chosen = options.choose_format(format, output, Format)
    if chosen == "csv":
        from spelgen.evaluation.csv_file import csv_text

        deliver(csv_text(results), output)
    elif chosen == "json":
        deliver(json.dumps(record) + "\n", output)
    else:
        deliver(results.text() + "\n", output)


def report(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN...", help="Run folders; several are compared on one page.")
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="FILE",
            help="HTML file, or .json for the data. Default: report.html in the run folder, runs.html for several.",
        ),
    ] = None,
    robot: Annotated[
        Path | None,
        typer.Option(metavar="ROBOT.urdf", help="URDF with its meshes, for the picture of the arm."),
    ] = None,
    trust: Trust = False,
) -> None:
    """Write an HTML page about one run or several."""
    from spelgen.fitting.run_folder import RunFolder

    if trust:
        for run in runs:
            RunFolder(run).load_module(trust=True)  # a module that ran once may run again
    if robot is not None and len(runs) > 1:
        raise typer.BadParameter("belongs to the page of one run", param_hint="'--robot'")
    if len(runs) == 1:
        from spelgen.render.report_page import write_report

        say(f"wrote {write_report(runs[0], output, robot)}")
    else:
        from spelgen.render.runs_page import write_runs

        say(f"wrote {write_runs(runs, output or Path('runs.html'))}")
