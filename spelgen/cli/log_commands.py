"""Commands about logs alone: `excite`, which motion to log, and `logs`, what was logged."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Literal

import typer

from spelgen.cli import options
from spelgen.cli.console import FAILED, counted, note, say
from spelgen.cli.options import Force, Joints, Mapping, Robot, SnapTolerance, Tip
from spelgen.files import write_text

HARMONICS_PER_SECOND = 0.4  # up to 0.4 Hz: what an arm follows well, far below its drives' ripple


def excite(
    robot: Robot,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE.csv", help="The motion.")],
    joints: Joints = None,
    tip: Tip = None,
    snap_tol: SnapTolerance = 2e-3,
    duration: Annotated[float, typer.Option("--duration", min=2.0, max=600.0, help="In seconds.")] = 30.0,
    rate: Annotated[float, typer.Option("--rate", min=1.0, max=10000.0, help="Samples a second.")] = 100.0,
    harmonics: Annotated[
        int | None, typer.Option("--harmonics", min=2, max=100, help="Default: 0.4 a second, at least 5.")
    ] = None,
    reach: Annotated[
        float, typer.Option("--reach", min=0.05, max=1.0, help="Part of the joints' ranges that is used.")
    ] = 0.9,
    speed: Annotated[
        float, typer.Option("--speed", min=0.05, max=1.0, help="Part of the velocity limits that is used.")
    ] = 0.7,
    trials: Annotated[int, typer.Option("--trials", min=1, help="Motions looked at.")] = 1000,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of the search.")] = 0,
    force: Force = False,
) -> None:
    """Propose a motion that shows an arm's inertial parameters and friction.

    Collisions are not checked.
    """
    from spelgen import pipeline
    from spelgen.excitation.design import design
    from spelgen.excitation.formatting import csv_text, text

    options.require_free(output, force=force)
    arm = pipeline.load(robot, options.names(joints), tip, snap_tol).arm
    with counted("searching") as progress:
        found = design(
            arm,
            duration=duration,
            rate=rate,
            harmonics=harmonics or max(5, round(HARMONICS_PER_SECOND * duration)),
            reach=reach,
            speed=speed,
            trials=trials,
            seed=seed,
            progress=progress,
        )
    say(text(found, arm))
    say(f"wrote {write_text(output, csv_text(found.motion, arm))}")


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
    from spelgen.logs.chunks import large_files, scan
    from spelgen.logs.formatting import text
    from spelgen.logs.read import read_logs
    from spelgen.logs.report import survey
    from spelgen.render.logs_page import page

    loaded = pipeline.load(robot, options.names(joints), tip, snap_tol)
    names = [coordinate.name for coordinate in loaded.arm.coordinates]
    kinds = [coordinate.kind for coordinate in loaded.arm.coordinates]
    mapped = options.mapping(mapping, robot, names)
    inputs = loaded.actuation.matrix()
    large = large_files(paths, names)
    found = survey(
        (each for _, each in scan(large, names, mapped, kinds))
        if large
        else read_logs(paths, names, mapping=mapped, joint_types=kinds),
        loaded.arm,
        inputs,
    )
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
