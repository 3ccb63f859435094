"""The command `compare`: train presets on the same logs of one arm or of many, and rank them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from spelgen.cli import options
from spelgen.cli.console import FAILED, note, progress_bar, say
from spelgen.cli.options import argument, flag, option, output_option
from spelgen.cli.train_settings import UsageError

if TYPE_CHECKING:
    from spelgen.comparison.arms import Comparison

Jobs = Annotated[
    int | None,
    option(
        "", "Number of parallel runs, one core each, by Ray; default: all cores if Ray is installed.", min=1
    ),
]


def compare(
    target: Annotated[
        Path, argument("TARGET", "URDF of an arm, or YAML file that lists arms and their logs.")
    ],
    data: options.Data = None,
    mapping: options.MappingFile = None,
    output: Annotated[
        Path | None, output_option("FOLDER", "Output folder; default: comparisons/TARGET.")
    ] = None,
    presets: Annotated[
        str | None,
        option(
            "A,B,C",
            "Presets or YAML files of designs; default: closed-form,hybrid on logs, else all presets.",
        ),
    ] = None,
    seeds: Annotated[int | None, option("", "Number of runs of each preset.", min=1)] = None,
    splits: Annotated[
        int | None, option("", "Folds of a cross-validation over trajectories; default: 1.", min=1)
    ] = None,
    steps: Annotated[int | None, option("", "Training steps of each run on a simulated arm.", min=1)] = None,
    ablation: Annotated[
        bool, flag("--ablation", "Compare designs from phnode to hybrid that differ by one change each.")
    ] = False,
    jobs: Jobs = None,
    address: options.Address = None,
) -> None:
    """Train presets on the same logs and rank them.

    An arm without logs is simulated by the protocol of its settings. The same command resumes an interrupted
    comparison, and reruns only changed runs.
    """
    from spelgen.comparison.arms import ablation_designs
    from spelgen.comparison.study import prepare_study, run_study
    from spelgen.comparison.tables import arm_sections
    from spelgen.fitting.process import locked, termination_as_interrupt
    from spelgen.render.comparison_page import write_comparison
    from spelgen.tasks import default_jobs, workers

    if ablation and presets is not None:
        raise UsageError("--ablation: names the presets itself, omit --presets")
    names = options.names(presets)
    values = {
        "presets": tuple(ablation_designs()) if ablation else names and tuple(names),
        "seeds": seeds, "splits": splits, "steps": steps,
    }  # fmt: skip
    # options of the command line take precedence over the file
    changes = {name: value for name, value in values.items() if value is not None}
    comparison = _comparison(target, data, mapping).model_copy(update=changes)
    name = target.stem + ("-logs" if data else "") + ("-ablation" if ablation else "")
    # the working folders of workers differ, so paths must be absolute
    folder = (output or Path("comparisons") / name).absolute()
    # all cores: a comparison takes hours on one
    parallel = jobs or default_jobs()
    # two simultaneous comparisons in one folder would overwrite each other's runs
    with locked(folder), termination_as_interrupt():
        with progress_bar("simulating") as progress:
            study = prepare_study(comparison, folder, progress)
        note(study.announcement(parallel))
        # the inputs exist before workers start, and each worker reads the same files
        with workers(parallel, address) as run_tasks:
            study = run_study(study, run_tasks, note)
        sections = arm_sections(study)
        # the tables are printed as well, since a page cannot be read in a terminal
        for section in sections:
            say(f"{section.name}: {section.sentence}\n")
            for table in section.tables:
                say(f"{table.text()}\n")
        say(f"wrote {write_comparison(study, sections)}")
    # the page is written in any case, with the runs that failed
    if study.failures:
        raise typer.Exit(FAILED)


def _comparison(target: Path, data: list[Path] | None, mapping: Path | None) -> Comparison:
    """Return the comparison of a URDF with these logs, or the comparison in a YAML file."""
    from spelgen.comparison.arms import YAML, ComparedArm, Comparison, load_comparison

    if target.suffix not in YAML:
        paths = tuple(path.absolute() for path in data or ())
        arm = ComparedArm(urdf=target.absolute(), data=paths, mapping=mapping and mapping.absolute())
        return Comparison.model_construct(arms={target.stem: arm})
    if data or mapping:
        raise UsageError("--data and --mapping: belong to a URDF; in a YAML file each arm has its own")
    return load_comparison(target.absolute())
