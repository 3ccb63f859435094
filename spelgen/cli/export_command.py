"""The command `export`: a trained model for other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from spelgen.cli import options
from spelgen.cli.console import answer
from spelgen.cli.options import Force, TextOrJson, Trust
from spelgen.exporting.exported import Format


def export(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A folder that `spelgen train` wrote.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FILE|FOLDER", help="Output file or folder.")
    ],
    to: Annotated[
        Format | None, typer.Option(help="Export format. Default: by the extension of the output.")
    ] = None,
    entry: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="A function to export, for c, casadi, onnx and torch; repeatable. Default: all but derivatives.",
        ),
    ] = None,
    force: Force = False,
    trust: Trust = False,
    format: TextOrJson = "text",
) -> None:
    """Export a trained model to other tools. Each export is compared with the model before it is written.

    urdf: the rigid bodies; for models with networks in M, the nearest rigid bodies. mjcf: rigid bodies, drives and
    friction for MuJoCo. c: a C99 header and source without dependencies. ros2: a colcon package around these. casadi,
    onnx, torch: a file for each function.
    """
    from spelgen.exporting.export import export as export_run
    from spelgen.exporting.exported import format_by_extension, require_fitting
    from spelgen.fitting.fitted import load_run

    if to is None:
        to = format_by_extension(output)
    # names and free places are checked before the model is loaded, which takes seconds
    require_fitting(to, output)
    options.require_free(output, force=force)
    result = export_run(load_run(run, trust=trust), to, entries=entry or ())
    # all or nothing: a failed parity check above has left no file
    files = [str(path) for path in result.write(output, force=force)]
    lines = [f"wrote {path}" for path in files]
    answer(format, {"files": files, "summary": result.summary}, *lines, *result.summary)
