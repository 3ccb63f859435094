"""What a fit is: the base of all objectives, and what every objective is given."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from spelgen.dynamics.bristles import bristle_reach
from spelgen.dynamics.protocol import has_rigid_bodies, input_of
from spelgen.errors import Diagnostic, RunError
from spelgen.fitting.dataset import TrainingData, WindowChoice, prepare_data
from spelgen.fitting.rollout import LossScales
from spelgen.fitting.run_record import Content, Record
from spelgen.fitting.streaming import LargeLogs, prepare_streamed
from spelgen.fitting.urdf_regularizer import UrdfRegularizer, urdf_regularizer
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.fits import FitConfig
from spelgen.settings.log_mapping import LogMapping
from spelgen.settings.messages import validated
from spelgen.spec import facts_of, logged_joints

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel
    from spelgen.fitting.progress import TrainingProgress

Logs = Sequence[Trajectory] | LargeLogs
Status = Literal["finished", "stopped early", "out of time", "interrupted"]


@dataclass(frozen=True)
class RunOptions:
    """How a fit runs, whatever it fits.

    device, threads: of torch. resume: go on from the folder's checkpoint, exactly as if there had been no interruption.
    force: replace a run. progress: show it on stderr. mapping: how the logs were read, kept with the run. notes: found
    before, to be reported with the others. began: from when the allowed time counts (`time.monotonic`); None: from now.
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
    """What is fitted to what, and how: the same for each objective.

    validation: the fraction of the logs that is set aside, or trajectories. urdf: the robot's, where it is known.
    began: from when the allowed time counts (`time.monotonic`). folder: of the run.
    """

    model: EmittedModel
    logs: Logs
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
    """One way to fit a model: what it needs of logs, how it starts, goes on and is resumed.

    It is made of a model that it is for, and a config of its own. `fit` calls `prepare` first, then `begin` for a new
    fit or `resume`, then `run`. It owns the run folder: what an objective wants kept it says by ``save``, and in
    `checkpoint`, history (the lines of metrics.jsonl) and results (what config.json says of how it went).
    """

    name: ClassVar[str]
    input: ClassVar[Literal["torque", "position"]] = "torque"
    """What the inputs are of the models that it is for, and what their logs have."""

    def __init__(self, request: FitRequest) -> None:
        self.request, self.model, self.config = request, request.model, request.config
        self.history: list[Content] = []
        self.results: Content = {}
        self._checkpoint: Content = {}

    @abstractmethod
    def prepare(self) -> PreparedLogs:
        """Check the logs and read what is fitted. Raises LogError and RunError."""

    @abstractmethod
    def begin(self) -> list[Diagnostic]:
        """Do what comes before the first checkpoint of a new fit; return what there is to tell."""

    def resume(self, checkpoint: Content, history: list[Content]) -> None:
        """Go on from what the run folder holds, by default a model that is fitted.

        Raises KeyError, RuntimeError, TypeError, ValueError or AttributeError where that is of another model.
        """
        self.model.load_state_dict(checkpoint["best_weights"])
        self._checkpoint = checkpoint

    def run(self, progress: TrainingProgress, save: Callable[[], None]) -> Status:
        """Fit until an end is reached, by default nothing more; call ``save`` where `checkpoint` should be kept.

        KeyboardInterrupt may end it anywhere.
        """
        return "finished"

    def checkpoint(self) -> Content:
        """Return what a resumed fit needs, with "best_weights", and the numbers of `run_record.Checkpoint`."""
        return self._checkpoint


class TorqueLogObjective(Objective):
    """An `Objective` on logs of torques, which are cut into windows: to fit, or to measure the model on."""

    def _cut_windows(self, window: int, stride: int) -> TrainingData:
        """Cut windows of the logs: to be fitted, and to be validated on. Raises LogError and RunError."""
        request = self.request
        reach = bristle_reach(self.model)
        choice = WindowChoice(window, stride, request.validation, request.seed, reach)
        if not isinstance(request.logs, LargeLogs):
            joints, kinds = logged_joints(self.model), self.model.joint_types
            return prepare_data(request.logs, joints, kinds, request.preprocessing, choice)
        if not isinstance(request.validation, float):
            raise RunError(
                "trajectories to validate logs larger than memory on", expected="a fraction of these logs"
            )
        return prepare_streamed(request.logs, request.preprocessing, choice)

    def _prepared(self, data: TrainingData, config: FitConfig) -> PreparedLogs:
        """Return what windows tell of the logs."""
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
        """Return the regularizer towards the request's URDF, where that has a weight and can be had."""
        urdf = self.request.urdf
        if not weight or urdf is None or not urdf.exists():
            return None
        try:
            return urdf_regularizer(urdf, logged_joints(self.model), self.model, data.training)
        except Exception as error:  # Pinocchio and its parser raise many kinds; the fit goes on without
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            message = f"fitted without the URDF's regularizer: {reason}"
            notes.append(Diagnostic("info", "no-regularizer", urdf.name, None, message))
            return None


def new_record(request: FitRequest, prepared: PreparedLogs) -> Record:
    """Return the record of a fit before it runs, with the resolved options that apply to the model and no others."""
    model, facts = request.model, facts_of(request.model)
    config, fraction = prepared.config, None
    if prepared.validation and isinstance(request.validation, float):
        fraction = request.validation
    scales = {}
    if prepared.scales is not None:
        scales["scales"] = {name: x.tolist() for name, x in prepared.scales._asdict().items()}
    return Record(
        schema=2,
        robot=facts.robot if facts else type(model).__name__,
        preset=facts.options.preset if facts else None,
        joints=list(logged_joints(model)),
        objective=config.objective,
        config=validated(type(config), config.record(rigid_bodies=has_rigid_bodies(model))),
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
        **scales,
    )
