"""Objective `rollout`: minimize the error of predicted windows in epochs, and repeat epochs that diverged."""

import copy
import math
from collections.abc import Callable
from typing import ClassVar

import torch
from torch import Tensor

from spelgen.dynamics.parameters import idle_residuals
from spelgen.errors import Diagnostic, RunError
from spelgen.fitting.momentum_objective import MomentumObjective
from spelgen.fitting.objective import Status
from spelgen.fitting.optimizers import WindowOptimizer
from spelgen.fitting.process import TrainingProgress
from spelgen.fitting.rollout import rollout_loss
from spelgen.fitting.run_record import Content
from spelgen.fitting.torque.objective import fit_torques, torque_samples
from spelgen.fitting.tuning import TUNING
from spelgen.logs.tuning import SLOWEST
from spelgen.logs.windows import Windows
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics
from spelgen.settings.fits import Rollout, TorqueFit


class RolloutObjective(MomentumObjective):
    """A fit in three steps: torque fit of rigid bodies, minimization of `momentum_loss`, epochs on predicted windows.

    The epochs have two stages. In the first stage, residual terms that the torque fit did not select are fixed: on
    short windows they would absorb a part of the rigid-body motion. In the second stage all weights are fitted,
    starting from the best weights of the first stage. A checkpoint contains the whole state, so that a resumed run
    gives the same numbers as an uninterrupted run.
    """

    name: ClassVar[str] = "rollout"
    config: Rollout
    saved_attributes: ClassVar[tuple[str, ...]] = (
        *MomentumObjective.saved_attributes, "rollbacks", "learning_rate_factor", "fixed", "stage_from", "stage_epoch",
    )  # fmt: skip

    def begin(self) -> list[Diagnostic]:
        """Compute the validation loss of the initial model; return diagnostics for the user.

        With the option `torque_first`, a `RigidBodyDynamics` is first fitted to the torques.
        """
        if self.config.torque_first and isinstance(self.model, RigidBodyDynamics):
            samples = torque_samples(self.model, self.data)
            if samples is not None:
                self.notes += fit_torques(self.model, samples, TorqueFit())[0]
            else:
                message = (
                    f"no torque fit: no log has a second of motion at {SLOWEST:g} Hz; only windows are fitted"
                )
                self.notes.append(Diagnostic("warning", "no-torque-fit", "logs", None, message))
        return super().begin()

    def resume(self, checkpoint: Content, history: list[Content]) -> None:
        """Resume an interrupted fit after its last complete epoch."""
        super().resume(checkpoint, history)
        self.optimizer = self._optimizer()
        self.model.load_state_dict(checkpoint["model"])
        self.optimizer.load_state_dict(checkpoint["optimizer"])
        self.generator.set_state(checkpoint["generator"])
        self.history = history[: self.epoch]

    def run(self, progress: TrainingProgress, save: Callable[[], None]) -> Status:
        """Minimize the momentum loss, then the rollout loss in epochs; call ``save`` after each of them."""
        self._start_clock()
        if not self.momentum_done:
            self._momentum_stage(progress)
            save()
        while (end := self._end()) is None or self._release(end):
            record = self._run_epoch()
            self.seconds = record["seconds"] = self.seconds_now()
            self.history.append(record)
            save()
            progress.epoch(record, self.config.epochs)
        return end

    def checkpoint(self) -> Content:
        """Return the content of checkpoint.pt: the state of the fit after the last epoch, and its best weights."""
        state = {"model": self.model.state_dict(), "optimizer": self.optimizer.state_dict()}
        return super().checkpoint() | state | {"generator": self.generator.get_state()}

    def _set_up(self) -> None:
        """Compute the validation loss, and initialize counters and optimizer of the first of two stages of epochs.

        In the first stage the parameters of idle residual terms, whose names are in `fixed`, are constant.
        """
        super()._set_up()
        self.generator = torch.Generator().manual_seed(self.request.seed)
        self.fixed, self.stage_from, self.stage_epoch = idle_residuals(self.model), 0.0, 0
        self.optimizer = self._optimizer()
        self.rollbacks, self.learning_rate_factor = 0, 1.0
        self._step_seconds, self._validation_seconds = 0.0, 0.0

    def _optimizer(self) -> WindowOptimizer:
        """Return a new optimizer of all weights that are not fixed. Gradients of fixed weights are disabled.

        In the first stage, the residual terms that the torque fit did not select are fixed.
        """
        for name, parameter in self.model.named_parameters():
            parameter.requires_grad_(name not in self.fixed)
        return self._new_optimizer(self.generator)

    def _rollout_loss(self, windows: Windows) -> Tensor:
        scales, solver = self.scales, self.config.solver
        return rollout_loss(self.model, windows, scales, self.substeps, solver) + self.penalty()

    def _end(self) -> Status | None:
        """Return the status with which the current stage of epochs ends; None if the stage continues."""
        if self.epoch >= self.config.epochs or self.optimizer.stalled:
            return "finished"
        patience = self.config.patience
        if self.stage_epoch:
            patience = min(patience, TUNING.second_patience)
        if self.epoch - max(self.best_epoch, self.stage_epoch) >= patience:
            return "stopped early"
        if self.fraction(self.seconds + self._step_seconds + self._validation_seconds) >= 1.0:
            return "out of time"
        return "finished" if self._done() >= self._stage_end else None

    def _run_epoch(self) -> Content:
        """Run one epoch and return its line of metrics.jsonl; repeat it at half the learning rate if it diverges."""
        while True:
            # `state` is the state of the fit before the epoch: a diverged epoch is repeated from it.
            state = copy.deepcopy((self.model.state_dict(), self.optimizer.state_dict(), self.step))
            steps, start = self._steps_in_time(), self.seconds_now()
            # The mean loss of an epoch is NaN if the loss or the gradient of any step is not finite. The validation
            # loss is then set to NaN, and the epoch is repeated with a lower learning rate (`_roll_back`).
            loss = self.optimizer.run(self._rollout_loss, self.training, steps, self._rate)
            trained = self.seconds_now()
            self.step, self._step_seconds = self.step + steps, (trained - start) / steps
            validation = self.validation.loss(self.substeps) if math.isfinite(loss) else math.nan
            self._validation_seconds = self.seconds_now() - trained
            if math.isfinite(validation):
                break
            self._roll_back(*state)
        self.epoch += 1
        if validation < self.best_loss:
            self._keep(self.substeps, validation)
        record = {
            "epoch": self.epoch, "step": self.step, "loss": loss, "validation": validation, "best": self.best_loss,
            "learning_rate": self._rate(), "substeps": self.substeps, "rollbacks": self.rollbacks,
        }  # fmt: skip
        if self.epoch % TUNING.probe_every == 0:
            self.substeps = self.validation.substeps(self.substeps)
        return record

    def _steps_in_time(self) -> int:
        """Return the number of optimizer steps of the next epoch, limited by the remaining time."""
        if math.isinf(self.allowed):
            return self.epoch_steps
        # In the first epoch, the time per step is still unknown: a short epoch measures it.
        if not self._step_seconds:
            return min(self.epoch_steps, TUNING.epoch_steps)
        remaining = self.allowed - self.seconds_now() - self._validation_seconds
        return max(1, min(self.epoch_steps, int(remaining / self._step_seconds)))

    def _rate(self, ahead: int = 0) -> float:
        """Return the learning rate of the step after ``ahead`` further steps; for ``ahead`` = 0, of the next step."""
        fraction = (self._done(ahead) - self.stage_from) / (self._stage_end - self.stage_from)
        return self.learning_rate_factor * self.learning_rate(fraction)

    def _done(self, ahead: int = 0) -> float:
        """Return the progress of the fit, 0 to 1.

        It is the larger one of two fractions: all optimizer steps that are completed after ``ahead`` more steps,
        divided by the number of steps of the fit, and the elapsed time divided by the time limit.
        """
        # The elapsed fraction of the time limit is included, so that the learning-rate schedule also ends with the
        # time limit.
        steps = self.config.epochs * self.epoch_steps
        return max((self.step + ahead) / steps, self.fraction(self.seconds))

    @property
    def _stage_end(self) -> float:
        return TUNING.first_stage if self.fixed else 1.0

    def _release(self, end: Status) -> bool:
        """Start the second stage of a fit, in which all weights are free; return False if there is no second stage.

        There is none if the first stage fixed no weights or completed no epoch, or if the time is up. end: status of
        the first stage.
        """
        if not self.fixed or end == "out of time" or not self.epoch:
            return False
        self.model.load_state_dict(self.best_weights)
        self.fixed, self.stage_from, self.stage_epoch = [], self._done(), self.epoch
        self.optimizer = self._optimizer()
        return self._end() is None

    def _roll_back(self, weights: Content, optimizer: Content, step: int) -> None:
        """Restore weights, optimizer and step number from before a diverged epoch; halve all later learning rates.

        Raises RunError after too many diverged epochs.
        """
        self.rollbacks += 1
        self.model.load_state_dict(weights)
        if self.rollbacks > TUNING.max_rollbacks:
            attempts = f"after {TUNING.max_rollbacks} attempts at half the learning rate each"
            kept = "; the best model so far is kept in model.pt" if self.request.folder else ""
            raise RunError(
                f"losses that are not finite, {attempts}", file=self.request.folder,
                do=f"check units and signs of the logs{kept}",
            )  # fmt: skip
        self.optimizer.load_state_dict(optimizer)
        self.step = step
        self.learning_rate_factor /= 2
