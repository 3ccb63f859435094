"""Fit an arm under position servos to its logs, and leave a run folder as every fit does."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spelgen.dynamics.protocol import has_servos
from spelgen.errors import Diagnostic, LogError, OptionError, RunError
from spelgen.files import write_json
from spelgen.fitting import workers
from spelgen.fitting.dataset import digest
from spelgen.fitting.fitted import Fit
from spelgen.fitting.loop import Status
from spelgen.fitting.process import termination_as_interrupt, threads_of_torch
from spelgen.fitting.progress import TrainingProgress
from spelgen.fitting.run_folder import RunFolder
from spelgen.fitting.run_lock import locked
from spelgen.fitting.run_record import require_same
from spelgen.fitting.servo.linear_servos import fit_linear_servos
from spelgen.fitting.servo_fit import ROUNDS, ServoRounds
from spelgen.fitting.servo_report import foreseen, foreseen_text, servo_record
from spelgen.fitting.servo_windows import ServoWindows, servo_windows
from spelgen.fitting.streaming import LargeLogs
from spelgen.logs.checks import check
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory, require_commands, require_joints
from spelgen.settings.fits import FitConfig, ServoFit
from spelgen.settings.log_mapping import LogMapping

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel


def require_input(model: EmittedModel, config: FitConfig) -> None:
    """Raise OptionError for an objective that does not belong to what commands the arm."""
    if has_servos(model) and not isinstance(config, ServoFit):
        raise OptionError(
            "objective", f"{config.objective} belongs to logs of torques, this arm has position servos"
        )
    if isinstance(config, ServoFit) and not has_servos(model):
        raise OptionError("objective", "servo belongs to arms with 'input: position' in their settings")


def fit_commands(
    model: EmittedModel,
    logs: Sequence[Trajectory] | LargeLogs,
    config: ServoFit,
    preprocessing: Preprocessing,
    *,
    seed: int,
    urdf: Path | None,
    folder: RunFolder | None,
    resume: bool,
    force: bool,
    mapping: LogMapping | None,
    notes: Sequence[Diagnostic],
    threads: int,
    progress: bool,
) -> Fit:
    """Arguments and errors as of `fit`; all logs are fitted, so that none is left to validate on."""
    run = None if workers.rank() else folder  # of several processes one writes
    if run is not None and not resume:
        run.require_free(force=force)
    logs = _commanded(model, logs)
    found = [*check(logs, model.facts.joints, model.joint_types), *notes]
    status: Status = "finished"
    with (
        threads_of_torch(threads),
        locked(run.path if run else None) as told,
        TrainingProgress(ROUNDS, show=progress) as shown,
        termination_as_interrupt(),
    ):
        found += told
        for note in found:
            shown.note(note)
        windows, before = servo_windows(logs, preprocessing), None
        record = _record(model, logs, windows, config, preprocessing, seed, mapping) | {"threads": threads}
        if resume and folder is not None:
            require_same(folder, record)
            before, urdf = folder.load_checkpoint(), folder.urdf
            record["foreseen"] = folder.read_config().get("foreseen")
        since = time.monotonic() - (before["seconds"] if before else 0.0)
        rounds = _rounds(model, windows, logs, before, folder)
        checkpoint = before or _checkpoint(rounds, since)
        if before is None:
            record["foreseen"] = foreseen(model, rounds.foreseen())
            text = foreseen_text(model, record["foreseen"])
            found.append(Diagnostic("info", "identifiability", "logs", None, text))
            shown.note(found[-1])
        if run is not None and not resume:
            run.start(model.source, urdf, force=force)
            _save(run, checkpoint)
            write_json(run.config, record)  # now there is a run, and it can be resumed
        try:
            for _ in rounds.run():
                checkpoint = _checkpoint(rounds, since)
                _save(run, checkpoint)
                shown.round(len(rounds.begun), rounds.reached.taken, rounds.reached.rms)
            solution = rounds.solution()
            record["servo"] = servo_record(model, solution) | {"linear": fit_linear_servos(windows).to_dict()}
            rms = float(solution.rms.square().mean().sqrt())
            checkpoint = _checkpoint(rounds, since) | {"best_loss": rms}
            _save(run, checkpoint)
            if run is not None:
                write_json(run.config, record)
        except KeyboardInterrupt:
            status = "interrupted"
    model.load_state_dict(checkpoint["best_weights"])
    return Fit(
        model=model, config=config, preprocessing=preprocessing, history=[], diagnostics=tuple(found),
        status=status, record=record, checkpoint=checkpoint, urdf=urdf,
        folder=None if folder is None else folder.path,
    )  # fmt: skip


def _commanded(model: EmittedModel, logs: Sequence[Trajectory] | LargeLogs) -> Sequence[Trajectory]:
    """The logs, which hold commands. Raises LogError where they do not."""
    if isinstance(logs, LargeLogs):
        raise LogError(
            "logs of positions larger than memory", expected="some hours of them: every tenth file, say"
        )
    for each in logs:
        require_joints(each, model.facts.joints)
        require_commands(each)
    return logs


def _record(
    model: EmittedModel,
    logs: Sequence[Trajectory],
    windows: ServoWindows,
    config: ServoFit,
    preprocessing: Preprocessing,
    seed: int,
    mapping: LogMapping | None,
) -> dict[str, Any]:
    """What goes into config.json before the fit (see `run_record.describe`)."""
    facts = model.facts
    return {
        "schema": 2, "robot": facts.robot, "preset": facts.options.preset, "joints": list(facts.joints),
        "objective": config.objective, "config": config.record(rigid_bodies=True),
        "preprocessing": asdict(preprocessing), "validation_fraction": None, "seed": seed,
        "data_digest": digest(logs), "training": [x.name for x in logs], "validation": [],
        "training_windows": len(windows.q), "validation_windows": 0, "device": "cpu",
        "mapping": (mapping or LogMapping(input="position")).model_dump(exclude_defaults=True),
    }  # fmt: skip


def _rounds(
    model: EmittedModel,
    windows: ServoWindows,
    logs: Sequence[Trajectory],
    before: dict[str, Any] | None,
    folder: RunFolder | None,
) -> ServoRounds:
    """Those of a new fit, or where there was one before, what its checkpoint goes on with."""
    if before is None:
        return ServoRounds(model, windows, logs)
    try:
        return ServoRounds(model, windows, logs, before["servo"])
    except (KeyError, RuntimeError, ValueError, TypeError, AttributeError) as error:
        file = None if folder is None else folder.checkpoint
        raise RunError("a checkpoint of another model", file=file, do="start a new run") from error


def _checkpoint(rounds: ServoRounds, since: float) -> dict[str, Any]:
    """What goes into checkpoint.pt."""
    return {
        "epoch": 0, "step": rounds.reached.taken, "best_epoch": 0, "best_loss": rounds.reached.rms, "rollbacks": 0,
        "learning_rate_factor": 1.0, "seconds": time.monotonic() - since, "substeps": rounds.windows.steps,
        "momentum_done": True, "best_weights": {name: x.clone() for name, x in rounds.model.state_dict().items()},
        "servo": rounds.state(),
    }  # fmt: skip


def _save(run: RunFolder | None, checkpoint: dict[str, Any]) -> None:
    if run is not None:
        run.save(checkpoint["best_weights"], checkpoint)
