"""Commands that train many models: `compare` presets on one robot, `fleet` many arms, presets, seeds and splits."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from spelgen.cli import options
from spelgen.cli.console import FAILED, note, progress_bar, say
from spelgen.cli.options import Address, Force, Robot
from spelgen.cli.train_settings import UsageError
from spelgen.errors import SpelgenError, suggestion


def compare(
    robot: Robot,
    output: Annotated[
        Path | None,
        options.output_option("FOLDER", "Output folder; default: comparisons/<robot>."),
    ] = None,
    presets: Annotated[
        str | None, typer.Option(metavar="A,B,C", help="Presets to compare, e.g. phnode,spel; default: all.")
    ] = None,
    seeds: Annotated[int | None, typer.Option(min=1, help="Number of runs of each preset.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Training steps of each run.")] = None,
    ablation: Annotated[
        bool,
        typer.Option(
            "--ablation", help="Compare variants from phnode to hybrid that differ by one change each."
        ),
    ] = False,
    urdf_error: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            metavar="PART",
            help="Relative error of the URDF's inertials, which models are then built with (0.3: 30 %). "
            "Default: models without inertials, all trained for the same number of steps.",
        ),
    ] = None,
    jobs: Annotated[
        int, typer.Option(min=1, help="Number of parallel runs, one core each; Ray runs more than one.")
    ] = 1,
    address: Address = None,
    force: Force = False,
) -> None:
    """Train every preset on the same simulated logs and compare.

    The same command resumes an interrupted comparison.
    """
    from spelgen.comparison.formatting import comparison_tables
    from spelgen.comparison.runs import run_study, time_steps
    from spelgen.comparison.study import VARIANTS, ablation_variants, prepare_study
    from spelgen.render.comparison_page import write_comparison
    from spelgen.tasks import workers

    # before logs are simulated
    if urdf_error is not None and steps is not None:
        raise UsageError("--steps: does not apply with --urdf-error, which uses the training defaults")
    variants = {variant.name: variant for variant in (ablation_variants() if ablation else VARIANTS)}
    chosen = options.names(presets) or list(variants)
    for preset in chosen:
        if preset not in variants:
            hint = suggestion(preset, variants)
            raise SpelgenError(f"unknown preset {preset!r}", expected=", ".join(variants), do=hint)
    name = robot.stem + ("-ablation" if ablation else "")
    if urdf_error is not None:
        name += f"-urdf-{urdf_error:g}"
    folder = output or Path("comparisons") / name
    with progress_bar("simulating") as progress:
        study = prepare_study(
            robot,
            folder,
            variants=[variants[preset] for preset in chosen],
            seeds=seeds,
            steps=steps,
            urdf_error=urdf_error,
            force=force,
            progress=progress,
        )
    # workers start after the logs exist: each reads the same files
    with workers(jobs, address) as run_tasks:
        run_study(study, run_tasks, note=note)
    tables = comparison_tables(list(study.results()), time_steps(study), study.settings.published)
    for table in tables:
        say(table.text() + "\n")
    say(f"wrote {write_comparison(study, tables)}")


def fleet(
    file: Annotated[
        Path, typer.Argument(metavar="FLEET.yaml", help="YAML file with arms, presets, seeds and splits.")
    ],
    output: Annotated[
        Path | None,
        options.output_option("FOLDER", "Output folder; default: fleets/<name of the file>."),
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
    from spelgen.fitting.process import locked, termination_as_interrupt
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
