"""Fit a model to logs, in memory; the command `spelgen train` is this with files."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from spelgen.dynamics.protocol import has_rigid_bodies
from spelgen.errors import Diagnostic, RunError, SettingsError
from spelgen.files import write_json
from spelgen.fitting.fitted import Fit, load_run
from spelgen.fitting.objective import FitRequest, Objective, RunOptions, Status, record_of
from spelgen.fitting.objectives import chosen_config, objective_of
from spelgen.fitting.process import locked, require_device, termination_as_interrupt, threads_of_torch
from spelgen.fitting.progress import TrainingProgress
from spelgen.fitting.run_folder import RunFolder
from spelgen.fitting.run_record import require_same
from spelgen.logs.dynamics_samples import SHORTEST
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.fits import FitConfig

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel
    from spelgen.urdf.robot import Robot

__all__ = ["Fit", "RunOptions", "fit", "load_run"]

AUTOMATIC = Preprocessing()


class ArmOfFile(Protocol):
    """An arm that was loaded from a file, as `spelgen.load_arm` gives it."""

    @property
    def robot(self) -> Robot: ...


QUIET = RunOptions()


def fit(
    model: ArmModel,
    logs: Trajectory | Sequence[Trajectory],
    config: FitConfig | None = None,
    *,
    preprocessing: Preprocessing = AUTOMATIC,
    validation: float | Sequence[Trajectory] = 0.25,
    seed: int = 0,
    arm: ArmOfFile | Path | str | None = None,
    folder: Path | str | None = None,
    options: RunOptions = QUIET,
) -> Fit:
    """Fit ``model`` to ``logs``; it then has the best weights that were found.

    config: a `TorqueFit`, `MomentumFit` or `Rollout`, or of an arm under position servos a `ServoFit`, all that it
    takes, which needs no validation; by default torque for rigid bodies, where logs are dense enough for accelerations,
    and rollout for networks. validation: the fraction of the logs that is set aside, whole trajectories drawn by
    ``seed``, or trajectories. arm: the arm or the URDF that the model was made from, for the regularizer towards it and
    for the run folder. folder: where checkpoints go after every epoch (see `RunFolder`); without one, `Fit.save`
    writes all that.
    Ctrl-C or SIGTERM end the fit with status "interrupted".
    Raises OptionError for an option that does not apply to this model, LogError, and RunError when the folder contains
    a run or cannot be resumed with this.
    """
    began = options.began or time.monotonic()
    run = None if folder is None else RunFolder(folder)
    logs = [logs] if isinstance(logs, Trajectory) else logs
    config = _config(model, logs, config)
    urdf = run.urdf if run is not None and options.resume else _urdf(arm)
    folder = None if run is None else run.path
    request = FitRequest(model, logs, config, preprocessing, validation, seed, urdf, options, began, folder)
    objective = objective_of(request)
    if run is not None and not options.resume:
        run.require_free(force=options.force)
    with threads_of_torch(options.threads), termination_as_interrupt(), locked(folder):
        require_device(options.device)
        prepared = objective.prepare()
        notes = [*prepared.notes, *options.notes]
        record = record_of(request, prepared)
        if run is not None and options.resume:
            require_same(run.read_config(), record, run.path)
            _resume(objective, run)
        else:
            notes += objective.begin()

        def save() -> None:
            if run is not None:
                checkpoint = objective.checkpoint()
                run.write_metrics(objective.history)
                run.save(checkpoint["best_weights"], checkpoint)

        if run is not None and not options.resume:
            run.start(model.source, urdf, force=options.force)
            save()
            write_json(run.config, record)  # now there is a run, and it can be resumed
        status = _run(objective, save, notes, show=options.progress)
        if objective.results:
            record |= objective.results
            if run is not None:
                write_json(run.config, record)
    checkpoint = objective.checkpoint()
    model.load_state_dict(checkpoint["best_weights"])
    model.requires_grad_(True)  # of what rested, too
    return Fit(
        model=model,
        config=prepared.config,
        preprocessing=prepared.preprocessing,
        history=objective.history,
        diagnostics=tuple(notes),
        status=status,
        record=record,
        checkpoint=checkpoint,
        urdf=urdf,
        folder=folder,
    )


def _config(model: ArmModel, logs: Sequence[Trajectory], config: FitConfig | None) -> FitConfig:
    """Return the configuration, by default what suits the model and its logs. Raises what `fit` raises for it."""
    if config is None:
        config = chosen_config(model, sample_rates(logs))
    if not isinstance(config, FitConfig):
        raise SettingsError(
            f"{config!r} as the configuration of a fit",
            expected="spelgen.TorqueFit(), MomentumFit(), Rollout() or ServoFit()",
        )
    config.require(rigid_bodies=has_rigid_bodies(model))
    return config


def sample_rates(logs: Sequence[Trajectory]) -> list[float]:
    """Return those of all logs [Hz] that are long enough for accelerations."""
    return [log.sample_rate for log in logs if log.duration >= SHORTEST]


def _urdf(arm: ArmOfFile | Path | str | None) -> Path | None:
    """Return the file of an arm that was loaded, or of a path."""
    if arm is None:
        return None
    return Path(arm) if isinstance(arm, str | Path) else Path(arm.robot.path)


def _resume(objective: Objective, run: RunFolder) -> None:
    checkpoint = run.load_checkpoint()
    try:
        objective.resume(checkpoint, run.read_metrics())
    except (KeyError, RuntimeError, ValueError, TypeError, AttributeError) as error:
        raise RunError("a checkpoint of another model", file=run.checkpoint, do="start a new run") from error
    run.write_metrics(objective.history)  # epochs after the checkpoint will be run again


def _run(
    objective: Objective, save: Callable[[], None], notes: Sequence[Diagnostic], *, show: bool
) -> Status:
    """Tell the notes, and go on until an end is reached, of which an interruption is one."""
    with TrainingProgress(show=show) as progress:
        for note in notes:
            progress.note(note)
        try:
            return objective.run(progress, save)
        except KeyboardInterrupt:
            return "interrupted"
