"""Commands about logs alone: `logs`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Literal

import typer

from spelgen.cli import options
from spelgen.cli.console import FAILED, note, say
from spelgen.cli.options import Joints, Mapping, SnapTolerance, Tip
from spelgen.files import write_text


def logs(
    paths: Annotated[list[Path], typer.Argument(metavar="LOGS...", help="Log files, or folders of them.")],
    robot: Annotated[Path, typer.Option("--robot", metavar="ROBOT.urdf", help="The arm that was logged.")],
    joints: Joints = None,
    tip: Tip = None,
    snap_tol: SnapTolerance = 2e-3,
    mapping: Mapping = None,
    format: Annotated[Literal["text", "json"], typer.Option("--format", help="Of the result.")] = "text",
    html: Annotated[
        Path | None, typer.Option("--html", metavar="FILE", help="Write a page with plots too.")
    ] = None,
    strict: Annotated[bool, typer.Option("--strict", help="Exit with 1 if there is any warning.")] = False,
) -> None:
    """Tell what logs hold, and what to doubt before training on them.

    Nothing is changed. Exit code 1 where the logs cannot be trained on.
    """
    from spelgen import pipeline
    from spelgen.data.logs import read_logs
    from spelgen.survey.page import page
    from spelgen.survey.survey import survey
    from spelgen.survey.tables import text

    loaded = pipeline.load(robot, options.names(joints), tip, snap_tol)
    names = [coordinate.name for coordinate in loaded.arm.coordinates]
    kinds = [coordinate.kind for coordinate in loaded.arm.coordinates]
    mapped = options.mapping(mapping, robot, names)
    trajectories = read_logs(paths, names, mapping=mapped, joint_types=kinds)
    inputs = loaded.actuation.matrix()
    found = survey(trajectories, loaded.arm, inputs)
    say(text(found) if format == "text" else json.dumps(found.to_dict(), indent=2))
    if html is not None:
        note(f"wrote {write_text(html, page(found, loaded.arm, inputs))}")
    for error in found.errors:
        note(str(error))
    warnings = sum(finding.severity == "warning" for finding in found.findings)
    if strict and warnings:
        note(f"{warnings} warning{'s' * (warnings > 1)}, and --strict allows none")
    if found.errors or (strict and warnings):
        raise typer.Exit(FAILED)
