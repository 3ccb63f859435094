"""One run of a comparison: build a model from a preset, train it, and evaluate it on the test logs."""

import hashlib
import time
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Self, cast

import torch
from pydantic import TypeAdapter, ValidationError

from spelgen.comparison.arms import ArmInputs
from spelgen.comparison.figures import Figures, simulated_figures
from spelgen.design import load_design
from spelgen.emission.assemble import ArmModel
from spelgen.emission.build import build
from spelgen.errors import RunError
from spelgen.evaluation.evaluate import evaluate
from spelgen.evaluation.plain import record
from spelgen.evaluation.results import Results
from spelgen.files import read_json, write_json
from spelgen.fitting.fit import FitOptions, RunOptions, fit
from spelgen.fitting.run_folder import RunFolder
from spelgen.fitting.tuning import TUNING as WINDOWS
from spelgen.labels import MODEL, observed, thousandths
from spelgen.logs.preprocessing import Preprocessing
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics
from spelgen.settings.fits import FitConfig, Rollout, fit_config
from spelgen.settings.training import ComparisonSettings, TrainingSettings
from spelgen.settings.yaml_document import Group
from spelgen.version import __version__

Errors = dict[str, dict[str, float | None]]
"""Measure -> predictor -> error; None for an error that is not finite. The first measure ranks the models."""


@dataclass(frozen=True)
class RunResult:
    """Results of a finished run.

    seconds: duration of the training [s]. parameters: number of trained parameters that the model uses. errors:
    {measure: {predictor: error}}; the first measure ranks the models. sizes: {label: number} of the model of a
    simulated arm, such as its numbers of network outputs, inputs and parameters (see `simulated_figures`); {} for logs
    of the user.
    """

    arm: str
    preset: str
    seed: int
    split: int
    seconds: float
    parameters: int
    errors: Errors
    sizes: Figures

    @classmethod
    def read(cls, path: Path) -> Self:
        """Return the result in a file result.json. Raises RunError if the file is malformed."""
        try:
            return TypeAdapter(cls).validate_python(read_json(path, RunError))
        except ValidationError as error:
            raise RunError("not the values of a result", file=path, do="remove it") from error


class Job(Group):
    """A run of a comparison, finished or not.

    design: name of a preset, or path of a YAML file. training: settings of fits to logs of the user. protocol: settings
    of fits to simulated logs, which are the same for all models. runs: folder of the run folders of the arm.
    """

    arm: str
    inputs: ArmInputs
    design: str
    seed: int
    split: int
    splits: int
    width: int
    depth: int
    training: TrainingSettings
    protocol: ComparisonSettings
    runs: Path

    @property
    def preset(self) -> str:
        """Return the name of the compared preset; for a YAML file, the name of the file."""
        return Path(self.design).stem

    @property
    def name(self) -> str:
        """Return the name of the run in messages."""
        name = f"{self.arm}, {self.preset}, seed {self.seed}"
        return f"{name}, split {self.split}" if self.splits > 1 else name

    @cached_property
    def folder(self) -> Path:
        """Run folder. Its name ends with a hash of all inputs of the run: other inputs give another folder.

        The inputs are the logs (path, size and modification time), the content of URDF, settings and design, the
        options and the version of spelgen.
        """
        protocol = self.protocol.model_dump_json(exclude={"seeds", "published"})
        options = self.model_dump_json(exclude={"design", "inputs", "protocol", "runs"})
        # The hash contains the content of the design and not its name, since a YAML file may have changed. The hash
        # contains the version of spelgen, since versions may give different results.
        sources = (__version__, load_design(self.design), self.inputs.digest, protocol, options)
        key = hashlib.sha256(repr(sources).encode()).hexdigest()[:8]
        return self.runs / f"{self.preset}-seed{self.seed}-split{self.split}-{key}"

    def build(self) -> ArmModel:
        """Return the untrained model of the run."""
        arm = self.inputs.load()
        return build(arm, self.design, width=self.width, depth=self.depth, seed=self.seed)

    def result(self) -> RunResult | None:
        """Return the result in result.json; None if the run is not finished. Raises RunError if it is malformed."""
        path = self.folder / "result.json"
        if not path.is_file():
            return None
        return RunResult.read(path)

    def config(self, model: ArmModel) -> FitConfig | FitOptions:
        """Return the configuration of the fit of the model.

        For a simulated arm, the configuration is the same for all models (see `equal_steps`). For logs of the user, it
        consists of the training settings of the arm.
        """
        if self.inputs.truth is not None:
            return self.equal_steps()
        objective = self.training.objective
        # The momentum objective is for networks only; rigid-body presets are fitted with their default objective.
        if objective == "momentum" and isinstance(model, RigidBodyDynamics):
            objective = None
        return FitOptions(objective, {}, self.training.options)

    def equal_steps(self) -> Rollout:
        """Return the configuration of a rollout fit to simulated logs.

        All models of a comparison take the same number of training steps, without regularization towards the URDF.
        """
        epochs, decay = -(-self.protocol.steps // WINDOWS.epoch_steps), self.protocol.weight_decay
        options = self.training.options | {"urdf_weight": 0.0, "epochs": epochs, "patience": epochs}
        options |= {"momentum_steps": self.protocol.momentum_steps}
        if decay is not None:
            options["weight_decay"] = decay
        return cast("Rollout", fit_config("rollout", rigid_bodies=False, defaults=options))

    def preprocessing(self) -> Preprocessing:
        """Return the preprocessing of the logs; simulated states have no noise and are not filtered."""
        # Simulated states have no noise, so a filter would only distort them.
        unfiltered = {} if self.inputs.truth is None else {"cutoff": 0.0}
        return Preprocessing(**(self.training.preprocessing | unfiltered))


def run_job(job: Job) -> RunResult:
    """Train and evaluate a model, write result.json, and return its content.

    An interrupted run is resumed from its checkpoint. A finished run is not repeated.

    Raises the errors of `fit` and `evaluate`, and KeyboardInterrupt if the process is asked to terminate.
    """
    finished = job.result()
    if finished is not None:
        return finished
    # One thread per worker: there is one worker per core, so more threads would wait for each other.
    torch.set_num_threads(1)
    run = RunFolder(job.folder)
    # The folder's name has a hash of all inputs: a fit found in it is an interrupted fit of this job, and is resumed.
    resume = run.config.exists()
    training, testing = job.inputs.split(job.split, job.splits)
    model, start = job.build(), time.monotonic()
    trained = fit(
        model, training, job.config(model), preprocessing=job.preprocessing(),
        validation=job.training.validation_fraction, seed=job.seed, arm=job.inputs.urdf, folder=job.folder,
        options=RunOptions(mapping=job.inputs.log_mapping(), resume=resume, force=not resume),
    )  # fmt: skip
    # An interrupted run has no result, so that the same command resumes it.
    if trained.status == "interrupted":
        raise KeyboardInterrupt
    seconds = time.monotonic() - start
    # Gradients are switched off for the evaluation to save memory.
    model.requires_grad_(False).eval()
    sizes: Figures = {}
    if job.inputs.truth is None:
        results = evaluate(trained, testing)
        write_json(run.evaluation, results.to_dict())
        errors = _errors(results)
    else:
        losses, sizes = simulated_figures(trained, training, testing, job.inputs.truth)
        # The first loss, the prediction loss over 1 s, ranks the models of a simulated arm.
        errors = {label: {MODEL: loss} for label, loss in losses.items()}
    result = RunResult(
        arm=job.arm, preset=job.preset, seed=job.seed, split=job.split, seconds=seconds,
        parameters=trained.parameters, errors=errors, sizes=sizes,
    )  # fmt: skip
    write_json(job.folder / "result.json", record(result))
    return result


def _errors(results: Results) -> Errors:
    """Return {label of an error measure, with its unit: {predictor: error}}.

    The order is: position errors under replayed commands (of position servos), relative errors per prediction horizon,
    nMSE of torques.
    """
    errors: Errors = {}
    for replay in results.replays:
        measure = f"position RMS, {replay.name} [{thousandths(results.joint_types)}]"
        errors[measure] = {name: 1000 * error.mean for name, error in replay.errors.items()}
    # The longest horizon is first, because the first measure ranks the models and long horizons are most difficult.
    for horizon in reversed(results.horizons):
        open_loop = [name for name in horizon.errors if not name.endswith(observed(""))]
        relative = {name: horizon.errors[name].mean_relative_rms for name in open_loop}
        errors[f"relative RMS, {horizon.name}"] = relative
    if results.torque:
        errors["torque nMSE"] = {name: error.mean_nmse for name, error in results.torque.items()}
    return errors
