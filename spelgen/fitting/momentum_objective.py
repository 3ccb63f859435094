"""Objective `momentum`: fit the weak form of the equations of motion.

The objective `rollout` contains the same minimization as a stage before its epochs.
"""

import copy
import math
import time
from collections.abc import Callable
from typing import ClassVar

import torch
from torch import Tensor

from spelgen.errors import Diagnostic
from spelgen.fitting.dataset import FitRequest, PreparedLogs, Validation, prepare_data
from spelgen.fitting.objective import Objective, Status
from spelgen.fitting.optimizers import LBFGS, MiniBatchAdamW, WindowOptimizer
from spelgen.fitting.process import TrainingProgress
from spelgen.fitting.rollout import momentum_loss
from spelgen.fitting.run_record import Content
from spelgen.fitting.tuning import TUNING
from spelgen.fitting.urdf_regularizer import urdf_regularizer
from spelgen.logs.windows import Windows
from spelgen.settings.fits import DEFAULTS, Rollout, WindowConfig


class MomentumObjective(Objective):
    """Minimization of `momentum_loss`. The initial weights are restored if they have a lower validation loss.

    Attributes:
        best_loss, best_weights: lowest validation loss so far, and the weights of the model with this loss.
        substeps: number of integration steps per sample interval.
        seconds: elapsed time of the fit [s].
        allowed: time limit of the fit [s].
        epoch_steps: number of optimizer steps per epoch.
    """

    name: ClassVar[str] = "momentum"
    # options of the fit; `prepare` sets the defaults that depend on the number of windows
    config: WindowConfig
    saved_attributes: ClassVar[tuple[str, ...]] = (
        "epoch", "step", "best_epoch", "best_loss", "best_weights", "seconds", "substeps", "momentum_done",
    )  # fmt: skip
    """Names of the attributes that a checkpoint contains."""

    def __init__(self, request: FitRequest) -> None:
        super().__init__(request)
        self.notes: list[Diagnostic] = []
        self.epoch = self.step = self.best_epoch = 0
        minutes = self.config.max_minutes
        self.allowed = math.inf if minutes is None else 60 * minutes  # time limit of the fit [s]

    def prepare(self) -> PreparedLogs:
        """Check, split and filter the logs, cut windows, make the regularizer towards the URDF. Raises LogError."""
        self.data = prepare_data(self.request, self.config.window, self.config.stride)
        self.config = self.config.resolved(len(self.data.training))
        self.regularizer = None
        if self.config.urdf_weight:
            # The regularizer scales M with the mean M of the initial model. A resumed run has the same scale, since its
            # model still has the initial weights at this point.
            self.regularizer = urdf_regularizer(self.request.urdf, self.model, self.data.training, self.notes)
        return self.data

    def begin(self) -> list[Diagnostic]:
        """Compute the validation loss of the initial model; return diagnostics for the user."""
        self._set_up()
        return self.notes

    def resume(self, checkpoint: Content, history: list[Content]) -> None:
        """Resume an interrupted fit from the best weights so far; an incomplete momentum stage is repeated."""
        self._set_up()
        for name in self.saved_attributes:
            setattr(self, name, checkpoint[name])
        self.model.load_state_dict(self.best_weights)

    def run(self, progress: TrainingProgress, save: Callable[[], None]) -> Status:
        """Run the momentum stage (`_momentum_stage`), unless a resumed run has completed it; return the status."""
        status: Status = "finished"
        if not self.momentum_done:
            self._start_clock()
            self._momentum_stage(progress)
            if self.fraction(self.seconds) >= TUNING.momentum_fraction:
                status = "out of time"
        save()
        return status

    def checkpoint(self) -> Content:
        """Return the content of checkpoint.pt: best weights, their validation loss, and progress of the fit."""
        return {name: vars(self)[name] for name in self.saved_attributes}

    def _set_up(self) -> None:
        """Move the model and the data to the device, set the batch and epoch sizes, and compute the validation loss."""
        device, config = self.request.options.device, self.config
        # The time to read and prepare the logs counts towards the time limit of the fit.
        self.seconds = time.monotonic() - self.request.began
        self.model.to(device)
        self.training, self.scales = self.data.training.to(device), self.data.scales.to(device)
        if self.regularizer is not None:
            self.regularizer = self.regularizer.to(device)
        self.batch = min(config.batch or DEFAULTS.batch, len(self.training))
        self.epoch_steps = TUNING.epoch_steps
        if config.optimizer != "lbfgs":
            self.epoch_steps = max(TUNING.epoch_steps, -(-len(self.training) // self.batch))
        solver, substeps = (config.solver, config.substeps) if isinstance(config, Rollout) else ("rk4", None)
        self.validation = Validation(
            self.model, self.data, device, batch=self.batch, solver=solver, substeps=substeps
        )
        self._keep(*self.validation.measure())
        self.momentum_done = not config.momentum_steps

    def _keep(self, substeps: int, loss: float) -> None:
        """Store the current weights as the best so far, with their number of integration steps and validation loss."""
        self.substeps, self.best_loss, self.best_epoch = substeps, loss, self.epoch
        self.best_weights = copy.deepcopy(self.model.state_dict())

    def _start_clock(self) -> None:
        self._since = time.monotonic() - self.seconds

    def seconds_now(self) -> float:
        """Return the elapsed time of the fit [s]."""
        return time.monotonic() - self._since

    def fraction(self, seconds: float) -> float:
        """Return ``seconds`` divided by the time limit of the fit; 0 without a limit, infinite if the limit is zero."""
        return seconds / self.allowed if self.allowed else math.inf

    def _new_optimizer(self, generator: torch.Generator) -> WindowOptimizer:
        """Return a new L-BFGS or AdamW optimizer of the trainable parameters; generator: order of AdamW's batches."""
        decay = self.config.weight_decay or 0.0
        if self.config.optimizer == "lbfgs":
            return LBFGS(self.model, decay)
        return MiniBatchAdamW(self.model, self.batch, decay, generator)

    def penalty(self) -> Tensor | float:
        """Return the regularization loss, (); 0 without a regularizer."""
        if self.regularizer is None:
            return 0.0
        return self.config.urdf_weight * self.regularizer.loss(self.model)

    def learning_rate(self, fraction: float) -> float:
        """Return the learning rate after a fraction (0 to 1) of the training: linear warm-up times cosine decay."""
        cosine = (1 + math.cos(math.pi * min(fraction, 1.0))) / 2
        decay = TUNING.final_rate + (1 - TUNING.final_rate) * cosine
        # Without the term 1e-3, the learning rate of the first step would be zero.
        warm_up = min(1.0, (fraction + 1e-3) / TUNING.warm_up)
        return (self.config.learning_rate or DEFAULTS.learning_rate) * warm_up * decay

    def _momentum_stage(self, progress: TrainingProgress) -> None:
        """Minimize the momentum loss, which needs no ODE solver.

        If the minimization does not lower the validation loss, the previous weights are restored. A run that is
        interrupted in this stage repeats the whole stage when it is resumed.
        """
        call, steps = TUNING.epoch_steps, self.config.momentum_steps
        optimizer = self._new_optimizer(torch.Generator().manual_seed(self.request.seed))

        def loss(windows: Windows) -> Tensor:
            """Return the momentum loss of the windows plus the regularization loss, ()."""
            return momentum_loss(self.model, windows, self.scales) + self.penalty()

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
        substeps, validation = self.validation.measure()
        if validation < self.best_loss:
            self._keep(substeps, validation)
        else:
            self.model.load_state_dict(self.best_weights)
        self.momentum_done, self.seconds = True, self.seconds_now()
