"""The objective momentum: steps on the weak form of the equations alone, with which fits of windows begin."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar

import torch

from spelgen.errors import Diagnostic
from spelgen.fitting.dataset import Measured, Validation
from spelgen.fitting.objective import FitRequest, PreparedLogs, Status, TorqueLogObjective
from spelgen.fitting.optimizers import LBFGS, MiniBatchAdamW, WindowOptimizer
from spelgen.fitting.rollout import momentum_loss
from spelgen.fitting.run_record import Content
from spelgen.fitting.tuning import WindowTuning
from spelgen.logs.windows import Windows
from spelgen.settings.fits import DEFAULTS, Solver, WindowConfig

if TYPE_CHECKING:
    from spelgen.fitting.progress import TrainingProgress

TUNING = WindowTuning()


class MomentumObjective(TorqueLogObjective):
    """Steps on the weak form, kept where they predict validation windows better. All windows are in memory.

    best_loss, best_weights: of the best model so far, by validation. substeps: of the integrator between samples.
    seconds: of the allowed time that is gone. call_steps, epoch_steps: in a call of the optimizer, and in an epoch.
    """

    name: ClassVar[str] = "momentum"
    config: WindowConfig  # resolved by `prepare`
    kept: ClassVar[tuple[str, ...]] = (
        "epoch", "step", "best_epoch", "best_loss", "best_weights", "seconds", "substeps", "momentum_done",
    )  # fmt: skip
    """The attributes that a checkpoint has."""

    def __init__(self, request: FitRequest) -> None:
        super().__init__(request)
        self.notes: list[Diagnostic] = []
        self.epoch = self.step = self.best_epoch = 0
        minutes = self.config.max_minutes
        self.allowed = math.inf if minutes is None else 60 * minutes  # [s]

    def prepare(self) -> PreparedLogs:
        """See `Objective`."""
        self.data = self._cut_windows(self.config.window, self.config.stride)
        self.config = self.config.resolved(len(self.data.training))
        # towards the URDF as the model has it before any fit, in a resumed run too
        self.regularizer = self._regularizer(self.data, self.config.urdf_weight, self.notes)
        return self._prepared(self.data, self.config)

    def begin(self) -> list[Diagnostic]:
        """Measure the model as it is."""
        self._set_up()
        return self.notes

    def resume(self, checkpoint: Content, history: list[Content]) -> None:
        """Go on from the best weights so far; steps that were not all taken start again."""
        self._set_up()
        self._restore(checkpoint)

    def run(self, progress: TrainingProgress, save: Callable[[], None]) -> Status:
        """See `Objective`."""
        status: Status = "finished"
        if not self.momentum_done:
            self._start_clock()
            self._momentum_stage(progress)
            if self.fraction(self.seconds) >= TUNING.momentum_fraction:
                status = "out of time"
        save()
        return status

    def checkpoint(self) -> Content:
        """See `Objective`."""
        return {name: getattr(self, name) for name in self.kept}

    def _set_up(self, solver: Solver = "rk4", substeps: int | None = None) -> None:
        """Measure the model as it is; solver, substeps: of the validation, as in `Rollout`."""
        device = self.request.options.device
        self.seconds = time.monotonic() - self.request.began
        self.model.to(device)
        self.training, self.scales = self.data.training.to(device), self.data.scales.to(device)
        if self.regularizer is not None:
            self.regularizer = self.regularizer.to(device)
        self.batch = min(self.config.batch or DEFAULTS.batch, len(self.training))
        self.call_steps = self.epoch_steps = TUNING.epoch_steps
        if not self._takes_all:
            self.epoch_steps = max(TUNING.epoch_steps, -(-len(self.training) // self.batch))
        self.validation = Validation(
            self.model, self.data, device, batch=self.batch, solver=solver, substeps=substeps
        )
        self._keep(self.validation.measure())
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
        self._since = time.monotonic() - self.seconds

    def seconds_now(self) -> float:
        """Return the time of the fit so far [s]."""
        return time.monotonic() - self._since

    def fraction(self, seconds: float) -> float:
        """Return how much of the allowed time these seconds are; 0 where any time is allowed."""
        return seconds / self.allowed if self.allowed else math.inf

    @property
    def _takes_all(self) -> bool:
        """Whether a step takes all windows at once."""
        return self.config.optimizer == "lbfgs"

    def _new_optimizer(self, generator: torch.Generator) -> WindowOptimizer:
        """Return one from the present weights, of those that require a gradient; ``generator`` orders batches."""
        decay = self.config.weight_decay or 0.0
        if self._takes_all:
            return LBFGS(self.model, decay)
        return MiniBatchAdamW(self.model, self.batch, decay, generator)

    def penalty(self) -> torch.Tensor | float:
        """Return what straying from the URDF costs."""
        if self.regularizer is None:
            return 0.0
        return self.config.urdf_weight * self.regularizer.loss(self.model)

    def learning_rate(self, fraction: float) -> float:
        """Return the learning rate when this much of training is done: a linear rise times a cosine down."""
        cosine = (1 + math.cos(math.pi * min(fraction, 1.0))) / 2
        fall = TUNING.final_rate + (1 - TUNING.final_rate) * cosine
        rise = min(1.0, (fraction + 1e-3) / TUNING.warm_up)
        return (self.config.learning_rate or DEFAULTS.learning_rate) * rise * fall

    def _momentum_stage(self, progress: TrainingProgress) -> None:
        """Take the momentum steps, which need no ODE solve, and keep them where validation says so.

        An interruption here starts the stage again on resumption.
        """
        model, call, steps = self.model, self.call_steps, self.config.momentum_steps
        optimizer = self._new_optimizer(torch.Generator().manual_seed(self.request.seed))

        def loss(windows: Windows) -> torch.Tensor:
            return momentum_loss(model, windows, self.scales) + self.penalty()

        for start in range(0, steps, call):
            spent = self.fraction(self.seconds_now()) / TUNING.momentum_fraction
            if spent >= 1.0:
                break

            def rate(step: int, start: int = start, spent: float = spent) -> float:
                return TUNING.momentum_factor * self.learning_rate(max((start + step) / steps, spent))

            value = optimizer.run(loss, self.training, min(call, steps - start), rate)
            if optimizer.stalled or not math.isfinite(value):
                break
            progress.momentum(min(start + call, steps), steps, value)
        end = self.validation.measure()
        if end.loss < self.best_loss:
            self._keep(end)
        else:
            model.load_state_dict(self.best_weights)
        self.momentum_done, self.seconds = True, self.seconds_now()
