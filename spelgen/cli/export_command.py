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
    to: Annotated[Literal["urdf"], typer.Option("--to", help="What to write.")] = "urdf",
    force: Force = False,
) -> None:
    """Write what was learned as a URDF and the settings beside it.

    Bodies of a closed-form model are written as they are; of other models, the rigid bodies nearest to them.
    """
    from spelgen.errors import RunError
    from spelgen.exporting.rigid_body_projection import make_twin
    from spelgen.exporting.urdf_file import settings_text, urdf_text
    from spelgen.files import write_bytes, write_text
    from spelgen.fitting.run_folder import RunFolder
    from spelgen.spec import read_facts

    if output.suffix == ".yaml":
        raise RunError(f"the name {output.name!r}", expected="FILE.urdf, beside which FILE.yaml is written")
    folder, beside = RunFolder(run), output.with_suffix(".yaml")
    for path in (output, beside):
        options.require_free(path, force=force)
    folder.read_json(folder.config)
    if not folder.urdf.exists():
        raise RunError("no robot.urdf", file=run, expected="a run of `spelgen train --robot FILE.urdf`")
    twin = make_twin(folder)
    robot = urdf_text(twin, folder.urdf, read_facts(folder.module).options.angle_tolerance)
    settings = settings_text(twin, folder.urdf)
    write_bytes(output, robot)
    write_text(beside, settings)
    count = len(twin.arm.bodies)
    say(f"wrote {output}: inertials of {count} {'body' if count == 1 else 'bodies'}, friction")
    say(f"wrote {beside}: rotor inertia, friction in both directions")
    if twin.mass_error is None:
        say("bodies: the model's own")
    else:
        say(
            f"bodies: nearest to the model; M differs by {twin.mass_error:.1%}, gravity by {twin.gravity_error:.1%}"
        )
    missed = ", ".join(
        f"{coordinate.name} {error:.0%}"
        for coordinate, error in zip(twin.arm.coordinates, twin.friction_error, strict=True)
    )
    say(f"friction as viscous + Coulomb, which misses of the model's: {missed}")
