"""The command `estimate`: payload, contacts and friction drift along logs of a fitted arm."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from spelgen.cli import options
from spelgen.cli.console import answer
from spelgen.cli.options import Accept, Data, MappingFile, MoreData, Run, TextOrJson


def estimate(
    run: Run,
    extra_logs: MoreData = None,
    data: Data = None,
    mapping: MappingFile = None,
    accept: Accept = None,
    alarms: Annotated[
        float | None,
        typer.Option(metavar="RATE", min=1e-6, help="False alarms of contact per minute; default: 1."),
    ] = None,
    output: Annotated[
        Path | None, options.output_option("FILE", "HTML page; default: estimate.html in the run folder.")
    ] = None,
    format: TextOrJson = "text",
) -> None:
    """Run the estimator along logs: payload, contacts, friction drift.

    It prints mass and centre of mass with 95 % intervals, contacts with times and torques, and the friction of each
    joint relative to the model, and writes a page with their curves.
    """
    paths = options.logs(data, extra_logs)
    from spelgen.fitting.fitted import load_run
    from spelgen.live.estimator import torque_model
    from spelgen.live.levels import noise_levels
    from spelgen.live.replay import replay
    from spelgen.logs.read import read_logs
    from spelgen.render.estimate_page import write_estimate

    fit = load_run(run)
    # reported before logs are read
    torque_model(fit)
    levels = noise_levels(fit)
    joints = list(fit.model.joint_names)
    logs = read_logs(
        paths, joints, mapping=options.log_mapping(joints, mapping or fit.record.mapping, accept)
    )
    results = replay(fit, logs, alarms)
    page = write_estimate(fit, levels, results, output or Path(run) / "estimate.html")
    rate = f"{levels.supported_alarms:.2g} false alarms per minute"
    record = {
        "run": str(run),
        "page": str(page),
        "supported_alarms_per_minute": levels.supported_alarms,
        "logs": [result.to_dict() for result in results],
    }
    lines = [result.text() for result in results]
    answer(format, record, *lines, f"thresholds of contact are supported down to {rate}", f"wrote {page}")
