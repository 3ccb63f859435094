"""The base class of all objectives, and their arguments: the request of a fit."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from spelgen.dynamics.bristles import bristle_reach
from spelgen.dynamics.protocol import input_of
from spelgen.emission.assemble import ArmModel, spec_of
from spelgen.errors import Diagnostic
from spelgen.fitting.dataset import TrainingData, WindowChoice, prepare_data
from spelgen.fitting.process import TrainingProgress
from spelgen.fitting.rollout import LossScales
from spelgen.fitting.run_record import Content, Record
from spelgen.fitting.urdf_regularizer import UrdfRegularizer, urdf_regularizer
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics
from spelgen.settings.fits import FitConfig
from spelgen.settings.log_mapping import LogMapping
from spelgen.settings.yaml_document import validated

Status = Literal["finished", "stopped early", "out of time", "interrupted"]


@dataclass(frozen=True)
class RunOptions:
    """How a fit runs.

    device, threads: of torch. resume: continue from the folder's checkpoint, exactly as if there had been no
    interruption. force: replace a run. progress: show it on stderr. mapping: with which the logs were read, kept with
    the run. notes: earlier diagnostics, reported with the others. began: start of the allowed time (`time.monotonic`);
    None: now.
    """

    device: str = "cpu"
    threads: int = 1
    resume: bool = False
    force: bool = False
    progress: bool = False
    mapping: LogMapping | None = None
    notes: Sequence[Diagnostic] = ()
    began: float | None = None


@dataclass(frozen=True)
class FitRequest:
    """The arguments of a fit.

    validation: the fraction of the logs that is set aside, or trajectories. urdf: of the robot, None if unknown.
    began: start of the allowed time (`time.monotonic`). folder: of the run, None without one.
    """

    model: ArmModel
    logs: Sequence[Trajectory]
    config: FitConfig
    preprocessing: Preprocessing
    validation: float | Sequence[Trajectory]
    seed: int
    urdf: Path | None
    options: RunOptions
    began: float
    folder: Path | None


@dataclass(frozen=True)
class PreparedLogs:
    """Logs that were checked and cut into windows, and the settings that depend on them.

    config, preprocessing: resolved. digest: see `dataset.digest`. training, validation: names of the logs. scales: of
    the validation loss; None without one. notes: diagnostics for the user.
    """

    config: FitConfig
    preprocessing: Preprocessing
    digest: str
    training: Sequence[str]
    validation: Sequence[str]
    training_windows: int
    validation_windows: int
    notes: Sequence[Diagnostic]
    scales: LossScales | None = None


class Objective(ABC):
    """A way to fit a model.

    `fit` calls `prepare`, then `begin` for a new fit or `resume`, then `run`. Only `fit` writes to the run folder: it
    writes `checkpoint` and history (the lines of metrics.jsonl) whenever ``save`` is called, and results (fields of
    `run_record.Record`, by name) at the end.
    """

    name: ClassVar[str]
    input: ClassVar[Literal["torque", "position"]] = "torque"
    """The input of the models that it fits, which is also in their logs."""

    def __init__(self, request: FitRequest) -> None:
        self.request, self.model, self.config = request, request.model, request.config
        self.history: list[Content] = []
        self.results: Content = {}
        self._checkpoint: Content = {}

    @abstractmethod
    def prepare(self) -> PreparedLogs:
        """Check the logs and prepare their samples. Raises LogError and RunError."""

    @abstractmethod
    def begin(self) -> list[Diagnostic]:
        """Do the steps of a new fit before its first checkpoint; return diagnostics."""

    def resume(self, checkpoint: Content, history: list[Content]) -> None:
        """Continue from the files of a run folder. By default the fit is complete, and its best weights are loaded.

        Raises KeyError, RuntimeError, TypeError, ValueError or AttributeError for files of another model.
        """
        # An objective without own states is finished at its checkpoint: only the weights count.
        self.model.load_state_dict(checkpoint["best_weights"])
        self._checkpoint = checkpoint

    def run(self, progress: TrainingProgress, save: Callable[[], None]) -> Status:
        """Run the fit until a stopping criterion holds, and return it; call ``save`` to write a `checkpoint`.

        By default `begin` does the whole fit. KeyboardInterrupt may be raised at any time.
        """
        return "finished"

    def checkpoint(self) -> Content:
        """Return the content of checkpoint.pt: the keys of `run_record.Checkpoint`, and states for `resume`."""
        return self._checkpoint


class TorqueLogObjective(Objective):
    """An `Objective` for logs with torques, which are cut into windows: for the fit, or only for validation."""

    def _cut_windows(self, window: int, stride: int) -> TrainingData:
        """Return the training and validation windows of the logs. Raises LogError and RunError."""
        request = self.request
        reach = bristle_reach(self.model)
        choice = WindowChoice(window, stride, request.validation, request.seed, reach)
        joints, kinds = self.model.joint_names, self.model.joint_types
        return prepare_data(request.logs, joints, kinds, request.preprocessing, choice)

    def _prepared(self, data: TrainingData, config: FitConfig) -> PreparedLogs:
        """Return the prepared logs of these windows."""
        return PreparedLogs(
            config=config,
            preprocessing=data.preprocessing,
            digest=data.digest,
            training=data.training_names,
            validation=data.validation_names,
            training_windows=len(data.training),
            validation_windows=len(data.validation),
            notes=data.diagnostics,
            scales=data.scales,
        )

    def _regularizer(
        self, data: TrainingData, weight: float, notes: list[Diagnostic]
    ) -> UrdfRegularizer | None:
        """Return the regularizer towards the URDF; None without a weight or a readable URDF."""
        urdf = self.request.urdf
        if not weight or urdf is None or not urdf.exists():
            return None
        try:
            return urdf_regularizer(urdf, self.model.joint_names, self.model, data.training)
        # Pinocchio and its parser raise many types; the fit continues without a regularizer
        except Exception as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            message = f"fitted without the URDF's regularizer: {reason}"
            notes.append(Diagnostic("info", "no-regularizer", urdf.name, None, message))
            return None


def new_record(request: FitRequest, prepared: PreparedLogs) -> Record:
    """Return the record of a fit before it runs, with the resolved options that apply to the model and no others."""
    model, spec = request.model, spec_of(request.model)
    config, fraction = prepared.config, None
    if prepared.validation and isinstance(request.validation, float):
        fraction = request.validation
    notes = [*prepared.notes, *request.options.notes]
    record = Record(
        schema=2,
        robot=spec.robot if spec else type(model).__name__,
        preset=spec.options.preset if spec else None,
        joints=list(model.joint_names),
        objective=config.objective,
        config=validated(type(config), config.record(rigid_bodies=isinstance(model, RigidBodyDynamics))),
        preprocessing=prepared.preprocessing,
        validation_fraction=fraction,
        seed=request.seed,
        data_digest=prepared.digest,
        training=list(prepared.training),
        validation=list(prepared.validation),
        training_windows=prepared.training_windows,
        validation_windows=prepared.validation_windows,
        mapping=request.options.mapping or LogMapping(input=input_of(model)),
        device=request.options.device,
        threads=request.options.threads,
        warnings=[
            f"{note.where}: {note.message}"
            for note in notes
            if note.severity == "warning" and note.where != "run"
        ],
    )
    if prepared.scales is None:
        return record
    scales = {name: x.tolist() for name, x in prepared.scales._asdict().items()}
    return record.model_copy(update={"scales": scales})
