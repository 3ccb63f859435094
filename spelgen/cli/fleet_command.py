"""The command `fleet`: many arms, presets, seeds and splits at once."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from spelgen.cli.console import FAILED, note, say
from spelgen.cli.options import Address


def fleet(
    file: Annotated[
        Path, typer.Argument(metavar="FLEET.yaml", help="YAML file with arms, presets, seeds and splits.")
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="FOLDER", help="Output folder; default: fleets/<name of the file>."
        ),
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option(min=1, help="Number of parallel runs, one core each; default: the number of cores."),
    ] = None,
    address: Address = None,
) -> None:
    """Train and evaluate every preset on every arm, in parallel.

    The same command resumes an interrupted fleet.
    """
    from spelgen.fitting.process import termination_as_interrupt
    from spelgen.fitting.run_lock import locked
    from spelgen.fleet.fleet import run_fleet
    from spelgen.fleet.ranking import fleet_listings
    from spelgen.fleet.schema import load_fleet
    from spelgen.render.fleet_page import write_fleet
    from spelgen.tasks import workers

    settings = load_fleet(file)
    # workers have folders of their own: paths must not depend on them
    folder = (output or Path("fleets") / file.stem).absolute()
    # of a container or a job of a scheduler, which may own fewer cores than the machine has
    count = jobs or len(os.sched_getaffinity(0))
    # two fleets in one folder would overwrite the runs of one another
    with locked(folder), termination_as_interrupt(), workers(count, address) as run_tasks:
        results = run_fleet(settings, folder, run_tasks, note)
    listings = fleet_listings(results)
    for listing in listings:
        say(listing.text() + "\n")
    say(f"wrote {write_fleet(results, listings, folder / 'fleet.html')}")
    # the page is written all the same: what failed is on it
    if results.failures:
        raise typer.Exit(FAILED)
