"""The objectives momentum and rollout: fit windows of the logs."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar

from spelgen.dynamics.protocol import has_rigid_bodies
from spelgen.errors import Diagnostic, LogError
from spelgen.fitting.objective import FitRequest, PreparedLogs, Status
from spelgen.fitting.run_record import Content
from spelgen.fitting.streaming import LargeLogs
from spelgen.fitting.torque.objective import fit_torques, torque_samples
from spelgen.fitting.torque_logs import TorqueLogObjective
from spelgen.fitting.validation import Measured, Validation, measure
from spelgen.fitting.window.loop import TrainingLoop
from spelgen.fitting.window.momentum import momentum_stage
from spelgen.fitting.window.problem import TUNING, Clock, WindowProblem
from spelgen.logs.rates import SLOWEST
from spelgen.settings.fits import MomentumFit, Rollout, TorqueFit, WindowConfig

if TYPE_CHECKING:
    from spelgen.fitting.progress import TrainingProgress


class WindowObjective(TorqueLogObjective):
    """An objective that fits windows, all of which are in memory."""

    config: WindowConfig  # resolved by `prepare`

    def __init__(self, request: FitRequest) -> None:
        super().__init__(request)
        assert isinstance(request.config, WindowConfig)
        self.config = request.config

    def prepare(self) -> PreparedLogs:
        """See `Objective`."""
        if isinstance(self.request.logs, LargeLogs):
            raise LogError(
                "logs larger than memory",
                expected="fewer logs, for example every tenth file",
                do="or fit torques, which read them in chunks: the objective torque",
            )
        self.data = self._cut_windows(self.config.window, self.config.stride)
        self.config = self.config.resolved(self.data.size)
        return self._prepared(self.data, self.config)


class MomentumObjective(WindowObjective):
    """Steps on the weak form alone, kept where they predict validation windows better."""

    name: ClassVar[str] = "momentum"
    config: MomentumFit

    def begin(self) -> list[Diagnostic]:
        """Measure the model as it is."""
        request = self.request
        notes: list[Diagnostic] = []
        regularizer = self._regularizer(self.data, self.config.urdf_weight, notes)
        self.problem = WindowProblem(self.model, self.data, self.config, request.device, regularizer)
        self.validation = Validation(self.model, self.data, request.device, batch=self.problem.batch)
        self.best = measure(self.model, self.validation)
        self.seconds = time.monotonic() - request.began
        self.done = False
        return notes

    def resume(self, checkpoint: Content, history: list[Content], record: Content) -> None:
        """Go on from the weights so far; steps that were not all taken start again."""
        self.begin()
        self.model.load_state_dict(checkpoint["best_weights"])
        self.best = Measured(checkpoint["substeps"], checkpoint["best_loss"], checkpoint["best_weights"])
        self.seconds, self.done = checkpoint["seconds"], checkpoint["momentum_done"]

    def run(self, progress: TrainingProgress, save: Callable[[], None]) -> Status:
        """See `Objective`."""
        status: Status = "finished"
        if not self.done and self.config.momentum_steps:
            clock = Clock(self.config.max_minutes, self.seconds)
            seed = self.request.seed
            self.best = momentum_stage(self.problem, self.validation, self.best, clock, progress, seed)
            self.seconds = clock.seconds
            if clock.fraction(clock.seconds) >= TUNING.momentum_fraction:
                status = "out of time"
        self.done = True
        save()
        return status

    def checkpoint(self) -> Content:
        """See `Objective`."""
        return {
            "epoch": 0,
            "step": 0,
            "best_epoch": 0,
            "best_loss": self.best.loss,
            "best_weights": self.best.weights,
            "seconds": self.seconds,
            "substeps": self.best.substeps,
            "momentum_done": self.done,
        }


class RolloutObjective(WindowObjective):
    """Torques first, of rigid bodies; then momentum; then predicted windows, epoch by epoch."""

    name: ClassVar[str] = "rollout"
    config: Rollout

    def begin(self) -> list[Diagnostic]:
        """Fit torques, and measure the model then."""
        return self._start(torque_first=self.config.torque_first and has_rigid_bodies(self.model))

    def resume(self, checkpoint: Content, history: list[Content], record: Content) -> None:
        """Go on from the last whole epoch."""
        self._start(torque_first=False)
        self.loop.restore(checkpoint, history)

    def run(self, progress: TrainingProgress, save: Callable[[], None]) -> Status:
        """See `Objective`."""
        return self.loop.run(progress, save)

    def checkpoint(self) -> Content:
        """See `Objective`."""
        return self.loop.state()

    def _start(self, *, torque_first: bool) -> list[Diagnostic]:
        """Make the loop; return what there is to tell."""
        request, config = self.request, self.config
        notes: list[Diagnostic] = []
        model = self.model
        # towards the URDF as the model has it before any fit, in a resumed run too
        regularizer = self._regularizer(self.data, config.urdf_weight, notes)
        if torque_first:
            notes += self._torque_stage()
        problem = WindowProblem(model, self.data, config, request.device, regularizer)
        validation = Validation(
            model,
            self.data,
            request.device,
            batch=problem.batch,
            solver=config.solver,
            substeps=config.substeps,
        )
        self.loop = TrainingLoop(
            problem,
            validation,
            config,
            seed=request.seed,
            seconds=time.monotonic() - request.began,
            folder=request.folder,
        )
        self.history = self.loop.history
        return notes

    def _torque_stage(self) -> list[Diagnostic]:
        samples = torque_samples(self.model, self.data)
        if samples is not None:
            return fit_torques(self.model, samples, TorqueFit())
        message = (
            f"no torque fit: no log that moves has {SLOWEST:g} Hz for a second; windows alone are fitted"
        )
        return [Diagnostic("warning", "no-torque-fit", "logs", None, message)]
