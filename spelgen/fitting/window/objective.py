"""The base of objectives on windows of logs, and the steps on the weak form of the equations that both begin with."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, ClassVar

import torch

from spelgen.errors import LogError
from spelgen.fitting.objective import FitRequest, PreparedLogs
from spelgen.fitting.rollout import momentum_loss
from spelgen.fitting.run_record import Content
from spelgen.fitting.streaming import LargeLogs
from spelgen.fitting.torque_logs import TorqueLogObjective
from spelgen.fitting.validation import Measured, Validation, measure
from spelgen.fitting.window.problem import TUNING, Clock, WindowProblem
from spelgen.logs.windows import Windows
from spelgen.settings.fits import Solver, WindowConfig

if TYPE_CHECKING:
    from spelgen.errors import Diagnostic
    from spelgen.fitting.progress import TrainingProgress


class WindowObjective(TorqueLogObjective):
    """An objective that fits windows, all of which are in memory.

    best_loss, best_weights: of the best model so far, by validation. substeps: of the integrator between samples.
    seconds: of the allowed time that is gone.
    """

    config: WindowConfig  # resolved by `prepare`
    kept: ClassVar[tuple[str, ...]] = (
        "epoch", "step", "best_epoch", "best_loss", "best_weights", "seconds", "substeps", "momentum_done",
    )  # fmt: skip
    """The attributes that a checkpoint has."""

    def __init__(self, request: FitRequest) -> None:
        super().__init__(request)
        assert isinstance(request.config, WindowConfig)
        self.config = request.config
        self.notes: list[Diagnostic] = []
        self.epoch = self.step = self.best_epoch = 0

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
        # towards the URDF as the model has it before any fit, in a resumed run too
        self.regularizer = self._regularizer(self.data, self.config.urdf_weight, self.notes)
        return self._prepared(self.data, self.config)

    def checkpoint(self) -> Content:
        """See `Objective`."""
        return {name: getattr(self, name) for name in self.kept}

    def _set_up(self, solver: Solver = "rk4", substeps: int | None = None) -> None:
        """Measure the model as it is; solver, substeps: of the validation, as in `Rollout`."""
        device = self.request.device
        self.seconds = time.monotonic() - self.request.began
        self.problem = WindowProblem(self.model, self.data, self.config, device, self.regularizer)
        self.validation = Validation(
            self.model, self.data, device, batch=self.problem.batch, solver=solver, substeps=substeps
        )
        self._keep(measure(self.model, self.validation))
        self.momentum_done = not self.config.momentum_steps

    def _restore(self, checkpoint: Content) -> None:
        """Go on from a checkpoint, with the best weights."""
        for name in self.kept:
            setattr(self, name, checkpoint[name])
        self.model.load_state_dict(self.best_weights)

    def _keep(self, measured: Measured) -> None:
        """Take what was measured for the best so far."""
        self.substeps, self.best_loss, self.best_weights = measured.substeps, measured.loss, measured.weights

    def _start_clock(self) -> None:
        self.clock = Clock(self.config.max_minutes, self.seconds)

    def _momentum_stage(self, progress: TrainingProgress) -> None:
        """Take the momentum steps, which need no ODE solve, and keep them where validation says so.

        An interruption here starts the stage again on resumption.
        """
        model, problem, steps = self.model, self.problem, self.config.momentum_steps
        optimizer = problem.optimizer(torch.Generator().manual_seed(self.request.seed))

        def loss(windows: Windows) -> torch.Tensor:
            return momentum_loss(model, windows, problem.scales) + problem.penalty()

        for done in range(0, steps, problem.call_steps):
            spent = self.clock.fraction(self.clock.seconds) / TUNING.momentum_fraction
            if spent >= 1.0:
                break

            def rate(step: int, done: int = done, spent: float = spent) -> float:
                return TUNING.momentum_factor * problem.learning_rate(max((done + step) / steps, spent))

            value = optimizer.run(loss, problem.training, min(problem.call_steps, steps - done), rate)
            if optimizer.stalled or not math.isfinite(value):
                break
            progress.momentum(min(done + problem.call_steps, steps), steps, value)
        end = measure(model, self.validation)
        if end.loss < self.best_loss:
            self._keep(end)
        else:
            model.load_state_dict(self.best_weights)
        self.momentum_done, self.seconds = True, self.clock.seconds
