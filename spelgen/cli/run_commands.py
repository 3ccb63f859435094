"""Commands about runs: `train`, `evaluate`, `report`."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from spelgen.cli import options
from spelgen.cli.console import INTERRUPTED, note, say
from spelgen.cli.options import (
    Data,
    Filter,
    Force,
    Mapping,
    MoreData,
    RobotOption,
    Run,
)
from spelgen.errors import ModuleError
from spelgen.spec import read_facts

if TYPE_CHECKING:
    from spelgen.fitting.dataset import TrainingConfig


def train(
    module: Annotated[
        Path | None,
        typer.Argument(metavar="MODULE.py", help="A module written by `spelgen build`.", show_default=False),
    ] = None,
    more: MoreData = None,
    data: Data = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="RUN", help="Run folder; default: runs/<module>.")
    ] = None,
    robot: RobotOption = None,
    mapping: Mapping = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the run in the run folder.")] = False,
    force: Force = False,
    source: Annotated[
        Path | None,
        typer.Option(
            "--from", metavar="RUN", help="Adapt a closed-form run to a load at the tip; no MODULE."
        ),
    ] = None,
    objective: Annotated[
        Literal["torque", "momentum", "rollout"] | None,
        typer.Option(
            "--objective", help="Default: of closed-form models torque, else rollout, after momentum steps."
        ),
    ] = None,
    momentum_steps: Annotated[
        int | None,
        typer.Option("--momentum-steps", min=0, help="On the weak form, before windows are predicted."),
    ] = None,
    epochs: Annotated[int | None, typer.Option("--epochs", min=1, help="At most so many.")] = None,
    patience: Annotated[
        int | None, typer.Option("--patience", min=1, help="Epochs without gain before the end.")
    ] = None,
    max_minutes: Annotated[
        float | None, typer.Option("--max-minutes", min=0.0, help="At most so long.")
    ] = None,
    batch: Annotated[int | None, typer.Option("--batch", min=1, help="Windows in a step.")] = None,
    window: Annotated[int | None, typer.Option("--window", min=2, help="Samples in a window.")] = None,
    stride: Annotated[
        int | None, typer.Option("--stride", min=1, help="Samples from window to window.")
    ] = None,
    every: Annotated[int | None, typer.Option("--every", min=1, help="Take one sample of so many.")] = None,
    substeps: Annotated[
        int | None, typer.Option("--substeps", min=1, help="Integrator steps between samples.")
    ] = None,
    learning_rate: Annotated[
        float | None, typer.Option("--learning-rate", min=0.0, help="At its largest.")
    ] = None,
    optimiser: Annotated[
        Literal["adamw", "lbfgs"] | None,
        typer.Option("--optimiser", help="On batches, or on all windows at once: default where few."),
    ] = None,
    weight_decay: Annotated[
        float | None,
        typer.Option("--weight-decay", min=0.0, help="Of AdamW; or of the penalty of L-BFGS."),
    ] = None,
    prior: Annotated[
        float | None,
        typer.Option("--prior", min=0.0, help="Pull towards the URDF's own M and gravity; 0: none."),
    ] = None,
    validation_fraction: Annotated[
        float | None,
        typer.Option("--validation-fraction", min=0.01, max=0.9, help="Part of the trajectories."),
    ] = None,
    filter: Filter = None,
    seed: Annotated[int | None, typer.Option("--seed", min=0, help="Of split, order and batches.")] = None,
    device: Annotated[str | None, typer.Option("--device", help="cpu, cuda, ...")] = None,
    threads: Annotated[int | None, typer.Option("--threads", min=1, help="Of torch.")] = None,
    compile: Annotated[
        bool | None,
        typer.Option("--compile/--no-compile", help="The right-hand side by torch; needs a C++ compiler."),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Show no progress.")] = False,
) -> None:
    """Train a module on logs.

    What is not given here comes from the settings beside the robot.
    """
    flags = {
        "objective": objective, "momentum_steps": momentum_steps, "prior": prior, "epochs": epochs,
        "patience": patience, "max_minutes": max_minutes, "batch": batch, "window": window, "stride": stride,
        "every": every, "substeps": substeps, "learning_rate": learning_rate, "weight_decay": weight_decay,
        "optimiser": optimiser,
        "validation_fraction": validation_fraction, "filter": filter, "seed": seed, "device": device,
        "threads": threads, "compile": compile,
    }  # fmt: skip
    if source is not None:
        more = [*([module] if module else []), *(more or [])]  # all that stands there is logs
        module, robot = _of_run(source, robot)
    if module is None:
        raise typer.BadParameter("name a module, or a run with --from", param_hint="'MODULE.py'")
    paths = options.logs(data, more)
    from spelgen.fitting import train as training

    folder = output or Path("runs") / module.stem
    urdf = robot or _unchanged_urdf(module)
    config = _config(
        urdf, folder if resume else None, {key: value for key, value in flags.items() if value is not None}
    )
    result = training.train(
        module,
        paths,
        folder,
        config,
        urdf=urdf,
        source=source,
        mapping=options.mapping(mapping, None if resume else urdf, read_facts(module).joints),
        resume=resume,
        force=force,
        progress=not quiet,
    )
    say(f"{result.status} after {result.epochs} epochs, {result.steps} steps, {result.seconds:.0f} s")
    say(f"best validation loss {result.best_validation:.3g}, at epoch {result.best_epoch}")
    say(f"run folder: {folder}")
    if result.status == "interrupted":
        note("the best model so far is in the run folder; --resume goes on")
        raise typer.Exit(INTERRUPTED)


def evaluate(
    run: Run, more: MoreData = None, data: Data = None, mapping: Mapping = None, filter: Filter = None
) -> None:
    """Judge a trained run on test logs, beside its rivals."""
    paths = options.logs(data, more)
    from spelgen.evaluation import evaluate as evaluation
    from spelgen.fitting.run_folder import RunFolder
    from spelgen.render.tables import result_tables

    folder = RunFolder(run)
    named = None
    if mapping is not None:
        named = options.mapping(mapping, folder.urdf, read_facts(folder.module).joints)
    result = evaluation.evaluate(run, paths, cutoff=filter, mapping=named)
    for each in result.diagnostics:
        note(f"{each.severity}: {each.where}: {each.message}")
    count = len(result.trajectories)
    say(f"{result.robot} on {count} test trajector{'ies' if count != 1 else 'y'}; * marks the best of a row")
    for table in result_tables(result.to_dict()):
        say("\n" + table.text())


def report(
    run: Run,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="FILE", help="Default: report.html in the run folder."),
    ] = None,
) -> None:
    """Write one HTML page about a run."""
    from spelgen.render.report_page import write_report

    say(f"wrote {write_report(run, output)}")


def _of_run(source: Path, robot: Path | None) -> tuple[Path, Path | None]:
    """The module and the URDF of a run."""
    from spelgen.fitting.run_folder import RunFolder

    run = RunFolder(source)
    run.read_json(run.config)  # where there is no run, this says so
    return run.module, robot or (run.urdf if run.urdf.exists() else None)


def _unchanged_urdf(module: Path) -> Path | None:
    """The URDF of the module's name near it, when it is still the one the module was built from."""
    from spelgen.pipeline import find_urdf

    facts = read_facts(module)
    try:
        path = find_urdf(module, facts.urdf)
    except ModuleError:
        return None
    return path if hashlib.sha256(path.read_bytes()).hexdigest() == facts.urdf_sha256 else None


def _config(urdf: Path | None, resumed: Path | None, flags: dict[str, Any]) -> TrainingConfig:
    """The flags, and behind them what the run was started with, or the robot's settings."""
    from spelgen.fitting.dataset import TrainingConfig
    from spelgen.fitting.run_folder import RunFolder
    from spelgen.settings.settings import load_settings
    from spelgen.settings.training import TrainingSettings

    if resumed is not None:
        run = RunFolder(resumed)
        return replace(TrainingConfig(**run.read_json(run.config)["config"]), **flags)
    settings = TrainingSettings() if urdf is None else load_settings(urdf).training
    return TrainingConfig.from_settings(settings, **flags)
