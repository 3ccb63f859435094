"""Fit an arm under position servos to its logs, and leave a run folder as every fit does."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from spelgen.errors import Diagnostic, LogError, OptionError, RunError
from spelgen.fitting.config import FitConfig, ServoFit
from spelgen.fitting.dataset import digest
from spelgen.fitting.fitted import Fit
from spelgen.fitting.linear_servo import fit_linear_servos
from spelgen.fitting.process import threads_of_torch
from spelgen.fitting.servo_fit import fit_servos
from spelgen.fitting.servo_report import servo_record
from spelgen.fitting.servo_windows import servo_windows
from spelgen.fitting.streaming import LargeLogs
from spelgen.logs.checks import check
from spelgen.logs.mapping import LogMapping
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory, require_joints

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel


def require_input(model: EmittedModel, config: FitConfig) -> None:
    """Raise OptionError for an objective that does not belong to what commands the arm."""
    if hasattr(model, "servo") and not isinstance(config, ServoFit):
        raise OptionError(
            "objective", f"{config.objective} belongs to logs of torques, this arm has position servos"
        )
    if isinstance(config, ServoFit) and not hasattr(model, "servo"):
        raise OptionError("objective", "servo belongs to arms with 'input: position' in their settings")


def fit_commands(
    model: EmittedModel,
    logs: Sequence[Trajectory] | LargeLogs,
    config: ServoFit,
    preprocessing: Preprocessing,
    *,
    seed: int,
    urdf: Path | None,
    folder: Path | str | None,
    resume: bool,
    force: bool,
    mapping: LogMapping | None,
    notes: Sequence[Diagnostic],
    threads: int,
) -> Fit:
    """Arguments and errors as of `fit`; all logs are fitted, so that none is left to validate on."""
    if resume:
        raise RunError(
            "a fit of servos, which has no epochs", expected="a run to go on with", do="start a new run"
        )
    if isinstance(logs, LargeLogs):
        raise LogError(
            "logs of positions larger than memory", expected="some hours of them: every tenth file, say"
        )
    for each in logs:
        require_joints(each, model.facts.joints)
        if each.u is None:
            raise LogError(
                "no commanded positions", file=each.file, element=f"trajectory {each.name}",
                expected="u: this arm has position servos",
            )  # fmt: skip
    found = [*check(logs, model.facts.joints, model.joint_types), *notes]
    since = time.monotonic()
    with threads_of_torch(threads):
        windows = servo_windows(logs, preprocessing)
        solution = fit_servos(model, windows, logs)
    servo = servo_record(model, solution) | {"linear": fit_linear_servos(windows).to_dict()}
    rms = float(solution.rms.square().mean().sqrt())
    names = [x.name for x in logs]
    facts = model.facts
    record = {
        "schema": 2, "robot": facts.robot, "preset": facts.options.preset, "joints": list(facts.joints),
        "objective": config.objective, "config": config.record(rigid_bodies=True),
        "preprocessing": asdict(preprocessing), "validation_fraction": None, "seed": seed,
        "data_digest": digest(logs), "training": names, "validation": [], "training_windows": len(windows.q),
        "validation_windows": 0, "mapping": (mapping or LogMapping(input="position")).model_dump(exclude_defaults=True),
        "servo": servo, "device": "cpu", "threads": threads,
    }  # fmt: skip
    weights = {name: x.clone() for name, x in model.state_dict().items()}
    checkpoint = {
        "epoch": 0, "step": solution.steps, "best_epoch": 0, "best_loss": rms, "rollbacks": 0,
        "learning_rate_factor": 1.0, "seconds": time.monotonic() - since, "substeps": windows.steps,
        "momentum_done": True, "best_weights": weights,
    }  # fmt: skip
    done = Fit(
        model=model, config=config, preprocessing=preprocessing, history=[], diagnostics=tuple(found),
        status="finished", record=record, checkpoint=checkpoint, urdf=urdf,
        folder=None if folder is None else Path(folder),
    )  # fmt: skip
    if folder is not None:
        done.save(folder, force=force)
    return done
