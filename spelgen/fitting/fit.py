"""Fit a model to logs in memory. The command `spelgen train` reads model and logs from files and calls `fit`."""

import pkgutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from spelgen.arm.configured_arm import Arm, urdf_path
from spelgen.baselines.registry import FittedBaselines, fit_baselines
from spelgen.emission.assemble import ArmModel, spec_of
from spelgen.emission.specify import arm_of_spec
from spelgen.errors import Diagnostic, OptionError, RunError, SettingsError, SpelgenError
from spelgen.files import write_json
from spelgen.fitting.dataset import FitRequest, RunOptions
from spelgen.fitting.fitted import Fit, load_run, required_spec
from spelgen.fitting.objective import Objective, Status, new_record
from spelgen.fitting.process import (
    TrainingProgress,
    locked,
    require_device,
    termination_as_interrupt,
    threads_of_torch,
)
from spelgen.fitting.run_folder import RunFolder
from spelgen.fitting.run_record import Checkpoint
from spelgen.logs.dynamics_samples import SHORTEST
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory, recordings
from spelgen.logs.tuning import shows_accelerations
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics
from spelgen.settings.fits import FitConfig, fit_config

__all__ = ["Fit", "RunOptions", "fit", "load_run"]

AUTOMATIC = Preprocessing()
QUIET = RunOptions()
OBJECTIVES = {
    "torque": "spelgen.fitting.torque.objective:TorqueObjective",
    "momentum": "spelgen.fitting.momentum_objective:MomentumObjective",
    "rollout": "spelgen.fitting.rollout_objective:RolloutObjective",
    "servo": "spelgen.fitting.servo.objective:ServoObjective",
}
"""Name of an objective -> its class, which is imported when a fit uses it."""
Rates = Callable[[], Sequence[float]]
"""Function that returns the sample rates of the logs [Hz]. It may read all logs, and is called only if necessary."""


@dataclass(frozen=True)
class FitOptions:
    """Options of a fit by name, checked when the objective is known.

    Attributes:
        objective: name of the objective; None: `default_objective` chooses it from the model and the logs.
        options: values of options by name; an option that does not apply to the objective is an error.
        defaults: values by name for options that are not given; defaults that do not apply to the objective are
            ignored.
    """

    objective: str | None = None
    options: Mapping[str, object] = field(default_factory=dict)
    defaults: Mapping[str, object] = field(default_factory=dict)


def fit(
    model: ArmModel,
    logs: Trajectory | Sequence[Trajectory],
    config: FitConfig | FitOptions | None = None,
    *,
    preprocessing: Preprocessing = AUTOMATIC,
    validation: float | Sequence[Trajectory] = 0.25,
    seed: int = 0,
    arm: Arm | Path | str | None = None,
    folder: Path | str | None = None,
    options: RunOptions = QUIET,
) -> Fit:
    """Fit ``model`` to ``logs``, and fit the baselines for comparison.

    After the fit, ``model`` has the weights of minimum validation loss (for objectives without validation, of minimum
    cost).

    Ctrl-C or SIGTERM end the fit with status "interrupted".

    Args:
        model: model from `spelgen.build` or `spelgen.load_module`; its weights are changed.
        logs: trajectories of the arm with torques, or with commands if the arm has position servos.
        config: a `TorqueFit`, `MomentumFit` or `Rollout`, or a `ServoFit` for an arm with position servos. A
            `ServoFit` uses all logs and needs no validation. Default: `ServoFit` for position servos; `TorqueFit` for
            rigid bodies if a log is sampled densely enough for accelerations; otherwise `Rollout`.
        preprocessing: filter, gaps and delay of the logs.
        validation: fraction of the logs that is set aside for validation (whole trajectories, chosen at random with
            ``seed``), or the validation trajectories.
        seed: random seed of the split and of the order of batches.
        arm: the arm that the model was made from, or its URDF, for the regularizer, the baselines and the run folder.
        folder: run folder, in which a checkpoint is written after every epoch (see `RunFolder`); without a folder,
            `Fit.save` writes all files.
        options: device, threads, resumption and progress.

    Returns:
        The fitted model with its record, and with the least-squares baselines if ``arm`` is known.

    Raises OptionError for an option that does not apply to this model, LogError, and RunError if the folder contains a
    run or cannot be resumed with these arguments.
    """
    began = options.began or time.monotonic()
    run = None if folder is None else RunFolder(folder)
    logs = recordings(logs, model.joint_names)
    config = choose_config(model, config, lambda: sample_rates(logs))
    # A resumed run uses its own copy of the URDF: the user's file may have changed.
    urdf = run.urdf if run is not None and options.resume else urdf_path(arm)
    folder = None if run is None else run.path
    request = FitRequest(model, logs, config, preprocessing, validation, seed, urdf, options, began, folder)
    objective = objective_of(request)
    if run is not None and not options.resume:
        # The run folder is checked before the logs are filtered and cut into windows, which may take minutes.
        run.require_free(force=options.force)
    # The run folder is created and locked after the check of the options, so that a wrong option creates no folder.
    with threads_of_torch(options.threads), termination_as_interrupt(), locked(folder):
        require_device(options.device)
        return _Fitting(request, objective, run).fitted()


class _Fitting:
    """A fit in progress: it prepares the logs, runs the objective, and writes the run folder, if there is one."""

    def __init__(self, request: FitRequest, objective: Objective, run: RunFolder | None) -> None:
        self.request, self.objective, self.run = request, objective, run
        prepared = objective.prepare()
        self.notes: list[Diagnostic] = [*prepared.diagnostics, *request.options.notes]
        self.record = new_record(request, objective.config, prepared)
        self.baselines: FittedBaselines = {}

    def fitted(self) -> Fit:
        """Run the fit and return its result."""
        request, objective = self.request, self.objective
        if self.run is None:
            self.notes += objective.begin()
        elif request.options.resume:
            self._resume(self.run)
        else:
            self.notes += objective.begin()
            # The run folder is written after `objective.begin` succeeded: logs that cannot be fitted create no run.
            with self.run.started(required_spec(request.model), request.urdf, force=request.options.force):
                self._save()
                mapping = self.record.mapping.model_dump(mode="json", exclude_defaults=True)
                if mapping:
                    write_json(self.run.mapping, mapping)
                write_json(self.run.config, self.record.to_dict())
        status = self._run()
        model, checkpoint = request.model, Checkpoint.model_validate(objective.checkpoint())
        model.load_state_dict(checkpoint.best_weights)
        # The objective may have disabled the gradients of some parameters; the caller's model has all gradients
        # enabled.
        model.requires_grad_(True)
        return Fit(
            model=model,
            history=objective.history,
            diagnostics=tuple(self.notes),
            status=status,
            record=self.record,
            checkpoint=checkpoint,
            baselines=self.baselines,
            urdf=request.urdf,
            folder=request.folder,
            logs=request.recordings,
        )

    def _resume(self, run: RunFolder) -> None:
        run.read_record().require_same_run(self.record, run.path)
        checkpoint, history = run.load_checkpoint(), run.read_metrics()
        try:
            self.objective.resume(checkpoint.content, history)
        except (KeyError, RuntimeError, ValueError, TypeError, AttributeError) as error:
            raise RunError(
                "a checkpoint of another model", file=run.checkpoint, do="start a new run"
            ) from error
        # Lines of epochs after the checkpoint are removed from metrics.jsonl: these epochs are run again.
        run.write_metrics(self.objective.history)
        # The baselines of the interrupted run are valid, because a run resumes only on the same logs.
        self.baselines = run.read_baselines()

    def _save(self) -> None:
        """Write the checkpoint, the best weights and the history into the run folder, if there is one."""
        if self.run is not None:
            checkpoint = self.objective.checkpoint()
            self.run.save(self.objective.history, checkpoint["best_weights"], checkpoint)

    def _run(self) -> Status:
        """Print the diagnostics of logs and preparation, fit the model and the baselines, and return the status.

        Ctrl-C ends the fit with status "interrupted", without baselines.
        """
        arm = self._baseline_arm()
        with TrainingProgress(show=self.request.options.progress) as progress:
            for note in self.notes:
                progress.note(note)
            try:
                status = self.objective.run(progress, self._save)
                self.record = self.record.model_copy(update=self.objective.results)
                if self.run is not None and self.objective.results:
                    write_json(self.run.config, self.record.to_dict())
                if arm is not None:
                    self.baselines = fit_baselines(arm, self.request.recordings, self.record.preprocessing)
                    if self.run is not None:
                        write_json(self.run.baseline, self.baselines)
            except KeyboardInterrupt:
                return "interrupted"
        return status

    def _baseline_arm(self) -> Arm | None:
        """Return the arm for the fit of baselines; None if the URDF is unknown, or if baselines are fitted already.

        A URDF that cannot be read is reported, and the model is fitted without baselines.
        """
        request = self.request
        if self.baselines or request.urdf is None or not request.urdf.exists():
            return None
        try:
            return arm_of_spec(spec_of(request.model), request.urdf)
        except SpelgenError as error:
            message = f"no least squares to compare with: {error}"
            self.notes.append(Diagnostic("warning", "no-baselines", "run", None, message))
            return None


def objective_of(request: FitRequest) -> Objective:
    """Return the `Objective` that a request names. Raises OptionError if it does not apply to the request's model."""
    name = request.config.objective
    objective: type[Objective] = pkgutil.resolve_name(OBJECTIVES[name])
    under = request.model.input_quantity
    if objective.input != under:
        message = (
            f"{name} belongs to arms with 'input: {objective.input}' in their settings, this has '{under}'"
        )
        raise OptionError("objective", message)
    return objective(request)


def default_objective(model: ArmModel, rates: Rates) -> str:
    """Return the name of the default objective for a model and for the sample rates of its logs.

    The default is "servo" for an arm with position servos. For a model with rigid bodies, it is "torque" if at least
    one log is sampled densely enough for accelerations (24 Hz). Otherwise it is "rollout". rates: function that returns
    the sample rates of the logs [Hz].
    """
    if model.input_quantity == "position":
        return "servo"
    if isinstance(model, RigidBodyDynamics) and any(map(shows_accelerations, rates())):
        return "torque"
    return "rollout"


def choose_config(model: ArmModel, requested: FitConfig | FitOptions | None, rates: Rates) -> FitConfig:
    """Return the requested configuration, or the default configuration with the requested options.

    Raises OptionError for an option that does not apply to the model. rates: function that returns the sample rates of
    the logs [Hz]; it determines the default objective and is called only if no objective is requested.
    """
    rigid_bodies = isinstance(model, RigidBodyDynamics)
    if isinstance(requested, FitConfig):
        requested.require(rigid_bodies=rigid_bodies)
        return requested
    if not isinstance(requested, FitOptions | None):
        raise SettingsError(
            f"{requested!r} as the configuration of a fit",
            expected="spelgen.TorqueFit(), MomentumFit(), Rollout() or ServoFit()",
        )
    chosen = requested or FitOptions()
    objective, defaults = chosen.objective, chosen.defaults
    if objective is None:
        objective = default_objective(model, rates)
        # Here the user chose no objective. For the default objective rollout, the default weight of the regularizer
        # towards the URDF is zero, since parameters of rigid bodies start at the values of the URDF and need no
        # regularizer. A user who names the objective rollout gets the default weight of `Rollout`.
        if rigid_bodies and objective == "rollout":
            defaults = {"urdf_weight": 0.0, **defaults}
    return fit_config(objective, rigid_bodies=rigid_bodies, options=chosen.options, defaults=defaults)


def sample_rates(logs: Sequence[Trajectory]) -> list[float]:
    """Return the sample rates [Hz] of the logs that are long enough for accelerations."""
    return [log.sample_rate for log in logs if log.duration >= SHORTEST]
