"""The command `export`: a trained model for other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from spelgen.cli import options
from spelgen.cli.console import say
from spelgen.cli.options import Force


def export(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A folder that `spelgen train` wrote.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE.urdf", help="Where to.")],
    to: Annotated[Literal["urdf"], typer.Option(help="What to write.")] = "urdf",
    force: Force = False,
) -> None:
    """Write what was learned as a URDF and the settings beside it.

    Bodies of a closed-form model are written as they are; of other models, the rigid bodies nearest to them.
    """
    from spelgen.exporting.export import export as exported

    for path in (output, output.with_suffix(".yaml")):
        options.require_free(path, force=force)
    found = exported(run, to)
    robot, settings = found.write(output, force=force)
    count = len(found.projection.arm.arm.bodies)
    say(f"wrote {robot}: inertials of {count} {'body' if count == 1 else 'bodies'}, friction")
    say(f"wrote {settings}: rotor inertia, friction in both directions")
    for line in found.summary:
        say(line)
