"""The command `train`: a module and log files in, a run folder out."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from spelgen.cli import options
from spelgen.cli.console import INTERRUPTED, note, say
from spelgen.cli.options import Data, Filter, Force, Mapping, MoreData, RobotOption, Trust
from spelgen.cli.train_start import Chosen, NotApplicable, begun, resumed
from spelgen.errors import ModuleError, OptionError
from spelgen.settings.fits import Adaptation, Objective, Optimizer, Solver
from spelgen.spec import read_facts

if TYPE_CHECKING:
    from spelgen.fitting.fitted import Fit
    from spelgen.logs.trajectory import Trajectory
    from spelgen.settings.fits import WindowConfig
    from spelgen.settings.log_mapping import LogMapping


def train(
    module: Annotated[
        Path | None,
        typer.Argument(
            metavar="MODULE.py",
            help="A module of `spelgen build`; with --resume, a run will do.",
            show_default=False,
        ),
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
    trust: Trust = False,
    source: Annotated[
        Path | None,
        typer.Option(
            "--from", metavar="RUN", help="Begin from a run; no MODULE. Torques adapt it, see --adapt."
        ),
    ] = None,
    adapt: Annotated[
        Adaptation | None,
        typer.Option(
            help="[torque] What differs from the run of --from: a load at the tip (the default), the friction of "
            "another day, or all of another unit."
        ),
    ] = None,
    objective: Annotated[
        Objective | None,
        typer.Option(help="Default: of rigid bodies torque, else rollout, after momentum steps."),
    ] = None,
    window: Annotated[
        int | None, typer.Option(min=2, help="[momentum, rollout] Samples in a window.")
    ] = None,
    stride: Annotated[
        int | None, typer.Option(min=1, help="[momentum, rollout] Samples from window to window.")
    ] = None,
    momentum_steps: Annotated[
        int | None,
        typer.Option(min=0, help="[momentum, rollout] On the weak form, before windows are predicted."),
    ] = None,
    torque_first: Annotated[
        bool | None, typer.Option(help="[rollout] Fit torques first; of rigid bodies.")
    ] = None,
    epochs: Annotated[int | None, typer.Option(min=1, help="[rollout] At most so many.")] = None,
    patience: Annotated[
        int | None, typer.Option(min=1, help="[rollout] Epochs without gain before the end.")
    ] = None,
    solver: Annotated[
        Solver | None, typer.Option(help="[rollout] rk4 of fixed steps, or torchdiffeq's dopri5.")
    ] = None,
    substeps: Annotated[
        int | None, typer.Option(min=1, help="[rollout] Steps of rk4 between samples.")
    ] = None,
    compile: Annotated[
        bool | None, typer.Option(help="[rollout] The right-hand side by torch; needs a C++ compiler.")
    ] = None,
    optimizer: Annotated[
        Optimizer | None,
        typer.Option(help="[momentum, rollout] On batches, or on all windows at once: default where few."),
    ] = None,
    batch: Annotated[int | None, typer.Option(min=1, help="[adamw] Windows in a step.")] = None,
    learning_rate: Annotated[float | None, typer.Option(min=0.0, help="[adamw] At its largest.")] = None,
    max_minutes: Annotated[
        float | None, typer.Option(min=0.0, help="[momentum, rollout] At most so long.")
    ] = None,
    evaluations: Annotated[
        int | None, typer.Option(min=1, help="[torque] Of the loss of networks, at most.")
    ] = None,
    weight_decay: Annotated[
        float | None, typer.Option(min=0.0, help="Of AdamW; or of the penalty of L-BFGS.")
    ] = None,
    urdf_weight: Annotated[
        float | None, typer.Option(min=0.0, help="Of staying near the URDF's own M and gravity; 0: none.")
    ] = None,
    validation_fraction: Annotated[
        float | None, typer.Option(min=0.01, max=0.9, help="Part of the trajectories.")
    ] = None,
    filter: Filter = None,
    decimation: Annotated[
        int | None, typer.Option(min=1, help="In windows, take one sample of so many.")
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Of split, order and batches.")] = None,
    device: Annotated[str, typer.Option(help="cpu, cuda, ...")] = "cpu",
    threads: Annotated[int, typer.Option(min=1, help="Of torch.")] = 1,
    quiet: Annotated[bool, typer.Option("--quiet", help="Show no progress.")] = False,
) -> None:
    """Fit a module to logs.

    What is not given here comes from the settings beside the robot. [torque], [momentum], [rollout]: the objectives
    that an option belongs to; it is an error beside another one.
    """
    since = time.monotonic()
    flags: dict[str, Any] = {
        "window": window, "stride": stride, "momentum_steps": momentum_steps, "torque_first": torque_first,
        "epochs": epochs, "patience": patience, "solver": solver, "substeps": substeps, "compile": compile,
        "optimizer": optimizer, "batch": batch, "learning_rate": learning_rate, "max_minutes": max_minutes,
        "evaluations": evaluations, "weight_decay": weight_decay, "urdf_weight": urdf_weight,
    }  # fmt: skip
    flags = {name: value for name, value in flags.items() if value is not None}
    if source is not None:
        more = [*([module] if module else []), *(more or [])]  # all that stands there is logs
        module, robot = _of_run(source, robot)
        objective = objective or "torque"
        if objective == "torque":
            flags["adapt"] = adapt or "load"
        elif adapt is not None:
            raise NotApplicable(f"--adapt: belongs to the objective torque, this fits {objective}")
    elif adapt is not None:
        raise NotApplicable("--adapt: belongs to --from")
    if module is None:
        raise typer.BadParameter("name a module, or a run with --from", param_hint="'MODULE.py'")
    paths = options.logs(data, more)
    folder = output or (module if resume and module.is_dir() else Path("runs") / module.stem)
    urdf = None if resume else robot or _unchanged_urdf(module)
    chosen = Chosen(objective, flags, {"cutoff": filter, "decimation": decimation}, validation_fraction, seed,
                    fitted=source is not None)  # fmt: skip
    start = resumed(folder, chosen) if resume else begun(module, urdf, chosen)
    given = options.mapping(mapping, urdf, read_facts(start.module).joints)
    check = None if urdf is None else _torque_check(urdf, start.module, given or start.mapping)
    from spelgen.fitting import workers
    from spelgen.fitting.train import train as train_files

    try:
        with workers.group(device) as own:
            found = train_files(
                start.module, paths, folder, start.config, urdf=urdf, source=source, mapping=given or start.mapping,
                preprocessing=start.preprocessing, validation=start.validation, seed=start.seed, resume=resume,
                force=force, trust=trust, device=own, threads=threads, progress=not quiet,
                since=since, require=check,
            )  # fmt: skip
            first = workers.rank() == 0
    except OptionError as error:
        raise NotApplicable(f"--{error.option.replace('_', '-')}: {error.got}") from error
    if not first:
        return
    if not resume and found.status != "interrupted":
        from spelgen.baselines.keep import keep_baseline

        keep_baseline(folder, paths)
    for line in _outcome(found):
        say(line)
    if found.calibration is not None and found.status != "interrupted":
        from spelgen.evaluation.forecast import good_for
        from spelgen.evaluation.subject import subject

        reach = good_for(subject(found).model, found.calibration)
        place = "nowhere" if reach is None else f"up to {reach:g} s ahead"
        say(f"forecasts clearly better than extrapolated motion: {place}")
    say(f"run folder: {folder}")
    if found.status == "interrupted":
        note("the best model so far is in the run folder; --resume goes on")
        raise typer.Exit(INTERRUPTED)


def _torque_check(
    urdf: Path, module: Path, mapping: LogMapping | None
) -> Callable[[Sequence[Trajectory]], None] | None:
    """What raises LogError for logs whose torques cannot be those of the module's arm; None: logs have no torques."""
    from spelgen.loaded_arm import load_arm
    from spelgen.log_checks.check_logs import require_possible_torques

    options = read_facts(module).options
    arm = load_arm(urdf, options.joints, options.tip, options.angle_tolerance)
    if arm.settings.input == "position":
        return None
    return lambda logs: require_possible_torques(logs, arm, mapping)


def _outcome(found: Fit) -> tuple[str, str]:
    """How a fit ended, and why where its status does not say so; what it came to."""
    if found.config.objective == "servo":
        from spelgen.fitting.servo_report import servo_text

        told = (
            servo_text(found.record["servo"])
            if "servo" in found.record
            else f"{found.steps} steps were taken"
        )
        return f"{found.status}: servos fitted in {found.seconds:.0f} s", told
    config, loss = cast("WindowConfig", found.config), f"validation loss {found.best_validation:.3g}"
    if not config.epochs:  # windows only judge
        return f"{found.status}: {config.objective} fitted in {found.seconds:.0f} s", loss
    why = {
        "stopped early": f": no better validation loss since epoch {found.best_epoch}",
        "out of time": f": --max-minutes {config.max_minutes or 0:g} is over",
        "finished": ": all epochs are run" if found.epochs >= config.epochs else ": no way further down",
    }.get(found.status or "", "")
    epochs = f"{found.epochs} epoch" if found.epochs == 1 else f"{found.epochs} epochs"
    ended = f"{found.status} after {epochs}, {found.steps} steps, {found.seconds:.0f} s"
    return ended + why, f"best {loss}, at epoch {found.best_epoch}"


def _of_run(source: Path, robot: Path | None) -> tuple[Path, Path | None]:
    """The module and the URDF of a run."""
    from spelgen.fitting.run_folder import RunFolder

    run = RunFolder(source)
    run.read_config()  # where there is no run, this says so
    return run.module, robot or (run.urdf if run.urdf.exists() else None)


def _unchanged_urdf(module: Path) -> Path | None:
    """The URDF of the module's name near it, when it is still the one the module was built from."""
    from spelgen.pipeline import find_urdf
    from spelgen.urdf.document import urdf_bytes

    facts = read_facts(module)
    try:
        path = find_urdf(module, facts.urdf)
    except ModuleError:
        return None
    return path if hashlib.sha256(urdf_bytes(path)).hexdigest() == facts.urdf_sha256 else None
