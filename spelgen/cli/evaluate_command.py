"""Commands about trained runs: `evaluate`, how good one is, and `report`, all about it on a page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from spelgen.cli import options
from spelgen.cli.console import note, say
from spelgen.cli.options import Data, Filter, Mapping, MoreData, Run, Trust


def evaluate(
    run: Run,
    more: MoreData = None,
    data: Data = None,
    mapping: Mapping = None,
    filter: Filter = None,
    trust: Trust = False,
) -> None:
    """Judge a trained run on test logs, beside its baselines."""
    paths = options.logs(data, more)
    import torch

    from spelgen.evaluation.evaluate import evaluate as evaluated
    from spelgen.evaluation.subject import read_test_logs
    from spelgen.files import write_json
    from spelgen.fitting.fitted import load_run
    from spelgen.fitting.run_folder import RunFolder
    from spelgen.identification.baseline import read_baseline
    from spelgen.logs.preprocessing import Preprocessing

    torch.set_num_threads(1)
    used = None if filter is None else Preprocessing(cutoff=filter)
    logs, baselines = read_test_logs(run, paths, mapping), read_baseline(RunFolder(run))
    found = evaluated(load_run(run, trust=trust), logs, baselines=baselines, preprocessing=used)
    write_json(RunFolder(run).evaluation, found.to_dict())
    for each in found.diagnostics:
        note(f"{each.severity}: {each.where}: {each.message}")
    say(found.text())


def report(
    run: Run,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="FILE", help="Default: report.html in the run folder."),
    ] = None,
    trust: Trust = False,
) -> None:
    """Write one HTML page about a run."""
    from spelgen.fitting.run_folder import RunFolder
    from spelgen.render.report_page import write_report

    if trust:
        RunFolder(run).load_module(trust=True)  # what ran once may run again
    say(f"wrote {write_report(run, output)}")
