"""The base class of all objectives, and the record of a fit."""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar, Literal

from spelgen.emission.assemble import spec_of
from spelgen.errors import Diagnostic
from spelgen.fitting.dataset import FitRequest, PreparedLogs
from spelgen.fitting.process import TrainingProgress
from spelgen.fitting.run_record import Content, Record
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics
from spelgen.settings.fits import FitConfig
from spelgen.settings.log_mapping import LogMapping
from spelgen.settings.yaml_document import validated

STORED_HASHES = 8
"""Number of hashes of each recording in config.json, enough to recognize a copy or a half of a recording."""
Status = Literal["finished", "stopped early", "out of time", "interrupted"]


class Objective(ABC):
    """Base class of objectives. An objective fits a model to logs: it defines the loss and how the loss is minimized.

    `fit` calls `prepare`, then `begin` for a new fit or `resume` for an interrupted one, then `run`. An objective does
    not write files. `fit` writes the `checkpoint` and the attribute history (the lines of metrics.jsonl) whenever the
    objective calls ``save``. At the end, `fit` adds the attribute results, a dict with fields of `run_record.Record`,
    to config.json.
    """

    name: ClassVar[str]
    input: ClassVar[Literal["torque", "position"]] = "torque"
    """Input quantity of the models that the objective can fit; the logs must contain this quantity."""

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
        """Run the part of a new fit that precedes the first checkpoint; return diagnostics for the user."""

    def resume(self, checkpoint: Content, history: list[Content]) -> None:
        """Restore the state of an interrupted fit from its checkpoint.pt and metrics.jsonl.

        The method of the base class restores only the best weights. Raises KeyError, RuntimeError, TypeError,
        ValueError or AttributeError if the files belong to another model.

        checkpoint: content of checkpoint.pt. history: lines of metrics.jsonl, one per epoch.
        """
        # An objective that does not override `resume` runs the whole fit in `begin`. Its only checkpoint is written
        # after the fit, so nothing remains to be fitted after the best weights are loaded.
        self.model.load_state_dict(checkpoint["best_weights"])
        self._checkpoint = checkpoint

    def run(self, progress: TrainingProgress, save: Callable[[], None]) -> Status:
        """Run the fit until a stopping criterion holds; return the status. ``save`` writes a checkpoint.

        The base class only returns "finished": objectives without epochs run the whole fit in `begin`. Ctrl-C raises
        KeyboardInterrupt at any time; the caller catches it.
        """
        return "finished"

    def checkpoint(self) -> Content:
        """Return the content of checkpoint.pt: the fields of `run_record.Checkpoint`, and the states for `resume`."""
        return self._checkpoint

    def _make_checkpoint(self, loss: float, seconds: float, substeps: int, step: int = 0) -> None:
        """Set the checkpoint of a finished fit without epochs.

        loss: final validation loss. seconds: duration [s]. substeps: number of integrator steps per sample interval.
        step: number of optimizer steps.
        """
        self._checkpoint = {
            "epoch": 0, "step": step, "best_epoch": 0, "best_loss": loss, "seconds": seconds, "substeps": substeps,
            "best_weights": copy.deepcopy(self.model.state_dict()),
        }  # fmt: skip


def new_record(request: FitRequest, config: FitConfig, prepared: PreparedLogs) -> Record:
    """Return the record of a fit without results, which are added after the fit.

    The record contains only the options that apply to the model, with their defaults filled in.
    """
    model, spec, options = request.model, spec_of(request.model), request.options
    notes = [note for note in (*prepared.diagnostics, *options.notes) if note.severity == "warning"]
    record = Record(
        schema=2,
        robot=spec.robot if spec else type(model).__name__,
        preset=spec.options.preset if spec else None,
        joints=list(model.joint_names),
        objective=config.objective,
        config=validated(type(config), config.record(rigid_bodies=isinstance(model, RigidBodyDynamics))),
        preprocessing=prepared.preprocessing,
        validation_fraction=None,
        seed=request.seed,
        data_digest=prepared.digest,
        training=list(prepared.training_names),
        validation=list(prepared.validation_names),
        fingerprints={x.name: x.fingerprint[:STORED_HASHES] for x in request.recordings},
        training_windows=prepared.window_counts[0],
        validation_windows=prepared.window_counts[1],
        mapping=options.mapping or LogMapping(input=model.input_quantity),
        device=options.device,
        threads=options.threads,
        # Only warnings about logs and links are recorded. Diagnostics at "run" are about the command and do not
        # describe the model.
        warnings=[f"{note.where}: {note.message}" for note in notes if note.where != "run"],
    )
    known: Content = {}
    if prepared.validation_names and isinstance(request.validation, float):
        known["validation_fraction"] = request.validation
    if prepared.scales is not None:
        known["scales"] = {name: x.tolist() for name, x in prepared.scales._asdict().items()}
    return record.model_copy(update=known)
