"""The loop of a fit to predicted windows: epochs, validation, checkpoints, and what happens when numbers blow up."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from spelgen.dynamics.residuals import idle_residuals
from spelgen.errors import RunError
from spelgen.fitting.optimizers import WindowOptimizer
from spelgen.fitting.progress import TrainingProgress
from spelgen.fitting.rollout import rollout_loss
from spelgen.fitting.run_record import Content
from spelgen.fitting.validation import Measured, Validation, measure
from spelgen.fitting.window.momentum import momentum_stage
from spelgen.fitting.window.problem import Clock, WindowProblem
from spelgen.logs.windows import Windows
from spelgen.settings.fits import Rollout
from spelgen.settings.tuning.fitting import LoopTuning

if TYPE_CHECKING:
    from spelgen.fitting.objective import Status

TUNING = LoopTuning()

PLAIN = (
    "epoch", "step", "best_epoch", "best_loss", "best_weights", "rollbacks", "learning_rate_factor", "seconds",
    "substeps", "momentum_done", "resting", "stage_from", "stage_epoch",
)  # fmt: skip


class TrainingLoop:
    """The changing state of one fit; `state` is all of it, so a resumed run repeats the same numbers.

    config: a resolved one. seconds: what was spent before, of the allowed time. folder: of the run, for messages.

    What stands beside rigid bodies and was not selected before rests until the bodies are done, for short windows are
    explained by it too, and worse. It then moves from the best weights so far, and stays where validation says so.
    """

    def __init__(
        self,
        problem: WindowProblem,
        validation: Validation,
        config: Rollout,
        *,
        seed: int = 0,
        seconds: float = 0.0,
        folder: Path | None = None,
    ) -> None:
        self.problem, self.validation, self.config = problem, validation, config
        self.model = problem.model
        self.seed, self.folder = seed, folder
        self.generator = torch.Generator().manual_seed(seed)
        self.resting, self.stage_from, self.stage_epoch = idle_residuals(self.model), 0.0, 0
        self.optimizer = self._optimizer()
        self.epoch = self.step = self.best_epoch = self.rollbacks = 0
        self.learning_rate_factor, self.seconds = 1.0, seconds
        self.clock = Clock(config.max_minutes, seconds)
        self._step_seconds, self._validation_seconds = 0.0, 0.0
        self.momentum_done = not config.momentum_steps
        self.history: list[Content] = []
        start = measure(self.model, validation)
        self.substeps, self.best_loss, self.best_weights = start.substeps, start.loss, start.weights

    def run(self, progress: TrainingProgress, save: Callable[[], None]) -> Status:
        """Go on until an end is reached; ``save`` is called after each epoch."""
        self.clock = Clock(self.config.max_minutes, self.seconds)
        if not self.momentum_done:
            self._momentum_stage(progress)
            save()
        while (end := self._end()) is None or self._release(end):
            record = self._run_epoch()
            self.seconds = record["seconds"] = self.clock.seconds
            self.history.append(record)
            save()
            progress.epoch(record, self.config.epochs)
        return end

    def _optimizer(self) -> WindowOptimizer:
        """Return one of the weights that do not rest."""
        for name, parameter in self.model.named_parameters():
            parameter.requires_grad_(name not in self.resting)
        return self.problem.optimizer(self.generator)

    def _momentum_stage(self, progress: TrainingProgress) -> None:
        start = Measured(self.substeps, self.best_loss, self.best_weights)
        best = momentum_stage(self.problem, self.validation, start, self.clock, progress, self.seed)
        self.substeps, self.best_loss, self.best_weights = best.substeps, best.loss, best.weights
        self.momentum_done = True
        self.seconds = self.clock.seconds

    def _rollout_loss(self, windows: Windows) -> torch.Tensor:
        scales, solver = self.problem.scales, self.config.solver
        return rollout_loss(self.model, windows, scales, self.substeps, solver) + self.problem.penalty()

    def _end(self) -> Status | None:
        if self.epoch >= self.config.epochs or self.optimizer.stalled:
            return "finished"
        patience = self.config.patience
        if self.stage_epoch:
            patience = min(patience, TUNING.second_patience)
        if self.epoch - max(self.best_epoch, self.stage_epoch) >= patience:
            return "stopped early"
        if self.clock.fraction(self.seconds + self._step_seconds + self._validation_seconds) >= 1.0:
            return "out of time"
        return "finished" if self._done() >= self._stage_end else None

    def _run_epoch(self) -> Content:
        """Run one epoch with finite losses, after as many attempts at a lower learning rate as that takes."""
        while True:
            before = copy.deepcopy((self.model.state_dict(), self.optimizer.state_dict(), self.step))
            loss = self._train_epoch()
            trained = self.clock.seconds
            validation = self.validation.loss(self.substeps) if math.isfinite(loss) else math.nan
            self._validation_seconds = self.clock.seconds - trained
            if math.isfinite(validation):
                break
            self._roll_back(*before)
        self.epoch += 1
        if validation < self.best_loss:
            self.best_loss, self.best_epoch = validation, self.epoch
            self.best_weights = copy.deepcopy(self.model.state_dict())
        record = {
            "epoch": self.epoch,
            "step": self.step,
            "loss": loss,
            "validation": validation,
            "best": self.best_loss,
            "learning_rate": self._rate(),
            "substeps": self.substeps,
            "rollbacks": self.rollbacks,
        }
        if self.epoch % TUNING.probe_every == 0:
            self.substeps = self.validation.substeps(self.substeps)
        return record

    def _train_epoch(self) -> float:
        """Return the mean loss over the epoch's steps; NaN as soon as a step has no finite loss or gradient."""
        steps, start = self._steps_in_time(), self.clock.seconds
        loss = self.optimizer.run(self._rollout_loss, self.problem.training, steps, self._rate)
        self._step_seconds = (self.clock.seconds - start) / steps
        self.step += steps
        return loss

    def _steps_in_time(self) -> int:
        """Return the steps of the next epoch: all, or as many as the remaining time allows at the pace so far."""
        steps = self.problem.epoch_steps
        if math.isinf(self.clock.allowed):
            return steps
        if not self._step_seconds:
            return min(steps, self.problem.call_steps)
        remaining = self.clock.allowed - self.clock.seconds - self._validation_seconds
        return max(1, min(steps, int(remaining / self._step_seconds)))

    def _rate(self, ahead: int = 0) -> float:
        """Return the learning rate so many steps ahead, over all steps or minutes, whichever end sooner."""
        fraction = (self._done(ahead) - self.stage_from) / (self._stage_end - self.stage_from)
        return self.learning_rate_factor * self.problem.learning_rate(fraction)

    def _done(self, ahead: int = 0) -> float:
        """Return the fraction of all steps or minutes that is gone so many steps ahead."""
        steps = self.config.epochs * self.problem.epoch_steps
        return max((self.step + ahead) / steps, self.clock.fraction(self.seconds))

    @property
    def _stage_end(self) -> float:
        return TUNING.first_stage if self.resting else 1.0

    def _release(self, end: Status) -> bool:
        """Let what rests move where the stage before ended by itself; return whether it does."""
        if not self.resting or end == "out of time" or not self.epoch:
            return False
        self.model.load_state_dict(self.best_weights)
        self.resting, self.stage_from, self.stage_epoch = [], self._done(), self.epoch
        self.optimizer = self._optimizer()
        return self._end() is None

    def _roll_back(self, weights: Content, optimizer: Content, step: int) -> None:
        """Undo an epoch whose numbers were not finite, and halve the learning rate from here on."""
        self.rollbacks += 1
        self.model.load_state_dict(weights)
        if self.rollbacks > TUNING.rollbacks:
            advice = "check units and signs of the logs"
            if self.folder is not None:
                advice += "; the best model so far is kept in model.pt"
            raise RunError(
                f"losses that are not finite, after {TUNING.rollbacks} attempts at half the learning rate each",
                file=self.folder,
                do=advice,
            )
        self.optimizer.load_state_dict(optimizer)
        self.step = step
        self.learning_rate_factor /= 2

    def state(self) -> Content:
        """Return all that a resumed run needs: what checkpoint.pt holds."""
        state = {name: getattr(self, name) for name in PLAIN}
        state["model"], state["optimizer"] = self.model.state_dict(), self.optimizer.state_dict()
        return state | {"generator": self.generator.get_state()}

    def restore(self, state: Content, history: list[Content]) -> None:
        """Continue from what `state` gave, after so many epochs."""
        for name in PLAIN:
            setattr(self, name, state[name])
        self.optimizer = self._optimizer()
        self.model.load_state_dict(state["model"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.generator.set_state(state["generator"])
        self.history[:] = history[: self.epoch]
