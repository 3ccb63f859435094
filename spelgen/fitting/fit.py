"""Fit a model to logs, in memory; the command `spelgen train` is this with files."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from spelgen.dynamics.bristles import bristle_reach
from spelgen.dynamics.protocol import has_rigid_bodies
from spelgen.errors import Diagnostic, RunError
from spelgen.files import write_json
from spelgen.fitting import workers
from spelgen.fitting.compiled import compiled
from spelgen.fitting.dataset import TrainingData, prepare_data
from spelgen.fitting.fitted import Fit, load_run
from spelgen.fitting.loop import TrainingLoop
from spelgen.fitting.process import require_device, termination_as_interrupt, threads_of_torch
from spelgen.fitting.progress import TrainingProgress
from spelgen.fitting.run_folder import RunFolder
from spelgen.fitting.run_lock import locked
from spelgen.fitting.run_record import describe, require_same
from spelgen.fitting.servo_run import fit_commands, require_input
from spelgen.fitting.stages import default_config, fit_torque_stage
from spelgen.fitting.streaming import LargeLogs, prepare_streamed
from spelgen.fitting.urdf_regularizer import UrdfRegularizer, urdf_regularizer
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.fits import FitConfig, Rollout, ServoFit, WindowConfig
from spelgen.settings.log_mapping import LogMapping
from spelgen.spec import logged_joints

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

__all__ = ["Fit", "fit", "load_run"]

Logs = Sequence[Trajectory] | LargeLogs
AUTOMATIC = Preprocessing()


def fit(
    model: EmittedModel,
    logs: Trajectory | Logs,
    config: FitConfig | None = None,
    *,
    preprocessing: Preprocessing = AUTOMATIC,
    validation: float | Sequence[Trajectory] = 0.25,
    seed: int = 0,
    arm: Any = None,
    device: str = "cpu",
    threads: int = 1,
    folder: Path | str | None = None,
    resume: bool = False,
    force: bool = False,
    mapping: LogMapping | None = None,
    progress: bool = False,
    notes: Sequence[Diagnostic] = (),
    since: float | None = None,
) -> Fit:
    """Fit ``model`` to ``logs``; it then has the best weights that were found.

    config: a `TorqueFit`, `MomentumFit` or `Rollout`, or of an arm under position servos a `ServoFit`, all that it
    takes, which needs no validation; by default torque for rigid bodies, where logs are
    dense enough for accelerations, and rollout for networks. validation: the fraction of the logs that is set aside,
    whole trajectories drawn by ``seed``, or trajectories. arm: the arm or the URDF that the model was made from,
    for the regularizer towards it and for the run folder.
    folder: where checkpoints go after every epoch (see `RunFolder`); without one, `Fit.save` writes all that.
    resume: go on from the folder's checkpoint, exactly as if there had been no interruption. force: replace a run.
    mapping: how the logs were read, kept with the run. notes: what was found before, to be told with the rest.
    since: from where the allowed time counts (`time.monotonic`); None: from now.
    In processes that `torchrun` started, each of which calls this, all fit together (see `workers.py`).
    Ctrl-C or SIGTERM end the fit with status "interrupted".
    Raises OptionError for an option that does not apply to this model, LogError, and RunError when the folder holds a
    run or cannot be resumed with this.
    """
    began = time.monotonic()
    logs = [logs] if isinstance(logs, Trajectory) else logs
    rigid_bodies = has_rigid_bodies(model)
    if config is None:
        config = default_config(model, sample_rates(logs))
    config.require(rigid_bodies=rigid_bodies)
    require_input(model, config)
    known = None if folder is None else RunFolder(Path(folder))
    if isinstance(config, ServoFit):
        return fit_commands(
            model, logs, config, preprocessing, seed=seed, urdf=_urdf(arm), folder=known, resume=resume, force=force,
            mapping=mapping, notes=notes, threads=threads, progress=progress and workers.rank() == 0,
        )  # fmt: skip
    run = known if workers.rank() == 0 else None  # of several processes one writes
    if run is not None and not resume:
        run.require_free(force=force)
    with threads_of_torch(threads), locked(run.path if run else None) as told:
        require_device(device)
        data = _prepared(model, logs, cast("WindowConfig", config), preprocessing, validation, seed)
        chosen = cast("WindowConfig", config.resolved(data.size))
        found = [*data.diagnostics, *notes, *told]
        stepped = _compiled(model, data, chosen, device, found)
        record = describe(model, chosen, data, seed=seed, validation=validation, mapping=mapping) | {
            "device": device,
            "threads": threads,
        }
        urdf = known.urdf if resume and known is not None else _urdf(arm)
        if resume and known is not None:
            require_same(known, record)
        regularizer = _regularizer(urdf, model, chosen, data, found)
        if not resume:
            found += fit_torque_stage(model, data, chosen, regularizer)
            if run is not None:
                run.start(model.source, urdf, force=force)
        loop = TrainingLoop(
            model,
            data,
            chosen,
            seed=seed,
            device=device,
            regularizer=regularizer,
            stepped=stepped,
            folder=run,
            seconds=workers.agreed(time.monotonic() - (since or began)),
        )
        if resume and known is not None:
            loop.restore(known)
        elif run is not None:
            loop.save()
            write_json(run.config, record)  # now there is a run, and it can be resumed
        with (
            TrainingProgress(chosen.epochs, show=progress and workers.rank() == 0) as shown,
            termination_as_interrupt(),
        ):
            for note in found:
                shown.note(note)
            status = loop.run(shown)
    model.load_state_dict(loop.best_weights)
    model.requires_grad_(True)  # of what rested, too
    return Fit(
        model=model,
        config=chosen,
        preprocessing=data.preprocessing,
        history=loop.history,
        diagnostics=tuple(found),
        status=status,
        record=record,
        checkpoint=loop.state(),
        urdf=urdf,
        folder=None if known is None else known.path,
    )


def sample_rates(logs: Logs) -> list[float]:
    """Of all logs [Hz]."""
    return logs.rates if isinstance(logs, LargeLogs) else [x.sample_rate for x in logs]


def _prepared(
    model: EmittedModel,
    logs: Logs,
    config: WindowConfig,
    preprocessing: Preprocessing,
    validation: float | Sequence[Trajectory],
    seed: int,
) -> TrainingData:
    if not isinstance(logs, LargeLogs):
        joints, kinds = logged_joints(model), model.joint_types
        return prepare_data(
            logs, joints, kinds, config, preprocessing, validation, seed, bristle_reach(model)
        )
    if not isinstance(validation, float):
        raise RunError(
            "trajectories to validate logs larger than memory on", expected="a fraction of these logs"
        )
    return prepare_streamed(logs, config, preprocessing, validation, seed, bristle_reach(model))


def _urdf(arm: Any) -> Path | None:
    """The file of an arm that was loaded, or of a path; None: neither."""
    if arm is None or isinstance(arm, str | Path):
        return None if arm is None else Path(arm)
    return Path(arm.robot.path)


def _regularizer(
    urdf: Path | None,
    model: EmittedModel,
    config: WindowConfig,
    data: TrainingData,
    notes: list[Diagnostic],
) -> UrdfRegularizer | None:
    """Where it is wanted and can be had; the torques of rigid bodies have a prior of their own."""
    wanted = isinstance(config, Rollout) or not has_rigid_bodies(model)
    if not wanted or not config.urdf_weight or urdf is None or not urdf.exists():
        return None
    try:
        return urdf_regularizer(urdf, logged_joints(model), model, data.training)
    except Exception as error:  # Pinocchio and its parser raise many kinds; the fit goes on without
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        message = f"fitted without the URDF's regularizer: {reason}"
        notes.append(Diagnostic("info", "no-regularizer", urdf.name, None, message))
        return None


def _compiled(
    model: EmittedModel, data: TrainingData, config: WindowConfig, device: str, notes: list[Diagnostic]
) -> EmittedModel:
    """The model as steps on windows use it, compiled where that is asked for."""
    if not config.compile:
        return model
    since = time.monotonic()
    batch = getattr(config, "batch", None)
    windows = data.training if batch is None else data.training[:batch]  # as steps take them
    ready = compiled(model.to(device), windows.to(device), data.scales.to(device))
    message = f"right-hand side compiled in {time.monotonic() - since:.0f} s"
    notes.append(Diagnostic("info", "compiled", "training", None, message))
    return ready
