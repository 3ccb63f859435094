"""The command `fleet`: many arms, presets, seeds and splits at once."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from spelgen.cli.console import FAILED, say
from spelgen.cli.options import Address


def fleet(
    file: Annotated[Path, typer.Argument(metavar="FLEET.yaml", help="Which arms, presets, seeds, splits.")],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="FOLDER", help="Default: fleets/<name of the file>."),
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Runs at a time, one core each; default: as there are cores.")
    ] = None,
    address: Address = None,
) -> None:
    """Train and judge every preset on every arm, on all cores or a Ray cluster.

    Started again, it goes on with what is left.
    """
    from spelgen.fitting.process import termination_as_interrupt
    from spelgen.fitting.run_lock import locked
    from spelgen.fleet.engine import engine
    from spelgen.fleet.fleet import run_fleet
    from spelgen.fleet.progress import FleetProgress
    from spelgen.fleet.ranking import fleet_listings
    from spelgen.fleet.schema import load_fleet
    from spelgen.render.fleet_page import write_fleet

    chosen = load_fleet(file)
    folder = (output or Path("fleets") / file.stem).absolute()
    workers = engine(jobs or len(os.sched_getaffinity(0)), address, chosen.gpus)
    with locked(folder), termination_as_interrupt(), workers as runs, FleetProgress() as progress:
        found = run_fleet(chosen, folder, runs, progress)
    listings = fleet_listings(found)
    for each in listings:
        say(each.text() + "\n")
    say(f"wrote {write_fleet(found, listings, folder / 'fleet.html')}")
    if found.failures:
        raise typer.Exit(FAILED)
