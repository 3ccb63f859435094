"""One run of a fleet: a module trained on its arm's logs and judged on its test logs, with a folder of its own."""

from __future__ import annotations

import hashlib
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from spelgen.arm.configured_arm import load_arm
from spelgen.emission.build import generate
from spelgen.emission.loading import read_spec
from spelgen.errors import RunError
from spelgen.evaluation.evaluate import evaluate
from spelgen.evaluation.subject import read_test_logs
from spelgen.files import read_bytes, read_json, write_json, write_text
from spelgen.fitting.fit import RunOptions
from spelgen.fitting.fitted import load_run
from spelgen.fitting.objectives import FitOptions
from spelgen.fitting.run_folder import RunFolder
from spelgen.fitting.train import train
from spelgen.fleet.prepare import SplitLogs
from spelgen.fleet.schema import Fleet, FleetRobot
from spelgen.logs.preprocessing import Preprocessing
from spelgen.settings.settings import load_settings
from spelgen.settings.training import TrainingSettings
from spelgen.settings.values import Group
from spelgen.version import __version__

RunResult = dict[str, Any]
"""The content of result.json."""


class Job(Group):
    """A run of a fleet. robot: its name there. design: a preset or its file. folder: of the run."""

    fleet: Fleet
    robot: str
    design: str
    seed: int
    split: int
    logs: SplitLogs
    folder: Path

    @property
    def arm(self) -> FleetRobot:
        """Return the arm that is trained."""
        return self.fleet.robots[self.robot]

    @property
    def preset(self) -> str:
        """Return the preset's name for people."""
        return Path(self.design).stem

    @property
    def name(self) -> str:
        """Return the job's name for people."""
        name = f"{self.robot}, {self.preset}, seed {self.seed}"
        if self.split:
            name += f", split {self.split}"
        return name

    @property
    def key(self) -> str:
        """Return a digest of all that the result follows from."""
        design = self.design
        if Path(design).suffix:
            design = read_bytes(Path(design), RunError).decode("utf-8", "replace")
        # where files lie does not change a result; `logs` has a digest of what is in them, and of the arm
        apart: dict[str, Any] = {
            "folder": True,
            "fleet": {"robots", "presets", "seeds", "splits"},
            "logs": {"train", "test"},
        }
        content = self.model_dump_json(exclude=apart, exclude_unset=True)
        return hashlib.sha256(f"{__version__} {design} {content}".encode()).hexdigest()[:16]

    def result(self) -> RunResult | None:
        """Return the result of this very job, where it has ended."""
        path = self.folder / "result.json"
        if not path.is_file():
            return None
        result = read_json(path, RunError)
        return result if result.get("key") == self.key else None


def run_job(job: Job) -> RunResult:
    """Train and judge, or go on where that was stopped; return the result, which result.json then holds too.

    Raises what `train` and `evaluate` raise, and KeyboardInterrupt when it was asked to end.
    """
    result = job.result()
    if result is not None:
        return result
    # as many workers as cores: more threads would wait for one another
    torch.set_num_threads(1)
    start, run = time.monotonic(), RunFolder(job.folder)
    _remove_foreign_run(job, run)
    # the robot's settings, and the fleet's over them
    training = load_settings(job.arm.urdf).training
    changes = job.fleet.training
    training = training.model_copy(update={name: getattr(changes, name) for name in changes.model_fields_set})
    resume = run.config.exists()
    module = run.module
    if not resume:
        arm = load_arm(job.arm.urdf, job.arm.joints, job.arm.tip)
        source = generate(arm, job.design, width=job.fleet.width, depth=job.fleet.depth)
        module = write_text(job.folder / "built.py", source)
    fit = train(
        module, job.logs.train, job.folder, _options(training, module), urdf=job.arm.urdf,
        preprocessing=Preprocessing(**training.preprocessing), validation=training.validation_fraction,
        seed=job.seed, options=RunOptions(mapping=job.logs.mapping, resume=resume, force=not resume),
    )  # fmt: skip
    # a worker that is asked to end leaves a checkpoint, from which the next one goes on
    if fit.status == "interrupted":
        raise KeyboardInterrupt
    result = {
        "key": job.key,
        "robot": job.robot,
        "preset": job.preset,
        "seed": job.seed,
        "split": job.split,
        "status": fit.status,
        "parameters": fit.parameters,
        "validation": fit.best_validation,
    }
    result |= _judged(job, run)
    result["seconds"] = time.monotonic() - start
    write_json(job.folder / "result.json", result)
    return result


def _remove_foreign_run(job: Job, run: RunFolder) -> None:
    """Take away the run of another job, one with other settings for example."""
    owner = job.folder / "job.json"
    if owner.is_file() and read_json(owner, RunError) == {"key": job.key}:
        return
    run.config.unlink(missing_ok=True)  # without it the folder is no run
    write_json(owner, {"key": job.key})


def _options(training: TrainingSettings, module: Path) -> FitOptions:
    """Return the objective that is asked for, or that suits the model and its logs, with its own options."""
    objective = training.objective
    # rigid bodies are not fitted to momenta: a fleet of several presets asks for these where they are
    if objective == "momentum" and read_spec(module).links:
        objective = None
    return FitOptions(objective, {}, training.options)


def _judged(job: Job, run: RunFolder) -> RunResult:
    """Return errors on the test logs, of the model and the URDF; evaluation.json has all of them.

    Least squares is left out: its stiff rollouts take ten times as long as all else, for every run anew.
    """
    logs = read_test_logs(job.folder, job.logs.test, job.logs.mapping)
    results = evaluate(replace(load_run(job.folder), baselines={}), logs)
    write_json(run.evaluation, results.to_dict())
    errors: dict[str, dict[str, float | None]] = {}
    for horizon in results.horizons:
        errors[horizon.name] = {}
        for predictor, error in horizon.errors.items():
            errors[horizon.name][predictor] = error.mean_relative_rms
    torque = {predictor: error.mean_nmse for predictor, error in results.torque.items()}
    return {"errors": errors, "torque": torque}
