"""What a fit is: the base of all objectives, and what every objective is given."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from spelgen.dynamics.bristles import bristle_reach
from spelgen.dynamics.protocol import has_rigid_bodies, input_of
from spelgen.errors import Diagnostic
from spelgen.fitting.dataset import TrainingData, WindowChoice, prepare_data
from spelgen.fitting.run_record import Content
from spelgen.fitting.urdf_regularizer import UrdfRegularizer, urdf_regularizer
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.fits import FitConfig
from spelgen.settings.log_mapping import LogMapping
from spelgen.spec import logged_joints

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel
    from spelgen.fitting.progress import TrainingProgress

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
    """Hold what `Objective.prepare` tells of the logs.

    config, preprocessing: with all that depends on the logs decided. record: what config.json says of the logs, see
    `run_record.Record`. notes: for people.
    """

    config: FitConfig
    preprocessing: Preprocessing
    record: Content
    notes: Sequence[Diagnostic]


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
        joints, kinds = logged_joints(self.model), self.model.joint_types
        return prepare_data(request.logs, joints, kinds, request.preprocessing, choice)

    def _prepared(self, data: TrainingData, config: FitConfig) -> PreparedLogs:
        """Return what windows tell of the logs."""
        return PreparedLogs(
            config=config,
            preprocessing=data.preprocessing,
            record={
                "data_digest": data.digest,
                "training": list(data.training_names),
                "validation": list(data.validation_names),
                "training_windows": len(data.training),
                "validation_windows": len(data.validation),
                "scales": {name: x.tolist() for name, x in data.scales._asdict().items()},
            },
            notes=data.diagnostics,
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


def record_of(request: FitRequest, prepared: PreparedLogs) -> Content:
    """Return what goes into config.json: options that were used, resolved, and nothing that does not apply."""
    model, facts = request.model, getattr(request.model, "facts", None)
    mapping = request.options.mapping or LogMapping(input=input_of(model))
    fraction = None
    if prepared.record["validation"] and isinstance(request.validation, float):
        fraction = request.validation
    return {
        "schema": 2,
        "robot": facts.robot if facts else type(model).__name__,
        "preset": facts.options.preset if facts else None,
        "joints": list(logged_joints(model)),
        "objective": prepared.config.objective,
        "config": prepared.config.record(rigid_bodies=has_rigid_bodies(model)),
        "preprocessing": asdict(prepared.preprocessing),
        "validation_fraction": fraction,
        "seed": request.seed,
        **prepared.record,
        "mapping": mapping.model_dump(exclude_defaults=True),
        "device": request.options.device,
        "threads": request.options.threads,
    }
