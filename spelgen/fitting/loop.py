"""The loop of a fit to windows: epochs, validation, checkpoints, and what happens when numbers blow up."""

from __future__ import annotations

import copy
import functools
import math
import time
from typing import TYPE_CHECKING, Any, Literal

import torch

from spelgen.dynamics.residuals import idle_residuals
from spelgen.errors import RunError
from spelgen.fitting import workers
from spelgen.fitting.dataset import TrainingData
from spelgen.fitting.optimizers import LBFGS, MiniBatchAdamW, WindowOptimizer
from spelgen.fitting.progress import TrainingProgress
from spelgen.fitting.rollout import Mean, momentum_loss, rollout_loss
from spelgen.fitting.run_folder import RunFolder
from spelgen.fitting.urdf_regularizer import UrdfRegularizer
from spelgen.fitting.validation import Validation
from spelgen.logs.windows import Windows
from spelgen.settings.fits import BATCH, FEW_WINDOWS, LEARNING_RATE, WindowConfig

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

MOMENTUM_FRACTION = 0.5  # of the allowed time, what the momentum steps may take
MOMENTUM_FACTOR = 10.0  # on the learning rate of the momentum steps, which are cheap and noisy
WARM_UP = 0.02  # part of all steps over which the learning rate rises
FINAL_RATE = 0.01  # the cosine ends at this part of the learning rate
EPOCH_STEPS = 20  # at least; few windows are passed over several times between validations
FIRST_STAGE = 0.8  # of all steps or minutes, at most, while residuals of rigid bodies rest
SECOND_PATIENCE = 3  # epochs: residuals that belong to the arm soon help
PROBE_EVERY = 5  # epochs: friction that is learned may be too stiff for the substeps so far
MAX_ROLLBACKS = 8

PLAIN = (
    "epoch", "step", "best_epoch", "best_loss", "best_weights", "rollbacks", "learning_rate_factor", "seconds",
    "substeps", "momentum_done", "resting", "stage_from", "stage_epoch",
)  # fmt: skip

Status = Literal["finished", "stopped early", "out of time", "interrupted"]


class TrainingLoop:
    """The changing state of one fit; `save` writes all of it, so a resumed run repeats the same numbers.

    config: a resolved one. stepped: what steps are taken with, the same weights, compiled maybe. folder: where
    checkpoints go; None: nothing is written. seconds: what was spent before, of the allowed time.

    What stands beside rigid bodies and has not entered before rests until the bodies are done, for short windows are
    explained by it too, and worse. It then moves from the best weights so far, and stays where validation says so.
    """

    def __init__(
        self,
        model: EmittedModel,
        data: TrainingData,
        config: WindowConfig,
        *,
        seed: int = 0,
        device: str = "cpu",
        regularizer: UrdfRegularizer | None = None,
        stepped: EmittedModel | None = None,
        folder: RunFolder | None = None,
        seconds: float = 0.0,
    ) -> None:
        self.folder, self.config, self.seed, self.device = folder, config, seed, device
        self.model = model.to(device)
        self.stepped = stepped or self.model
        self.together = workers.Together(self.model)
        self.training: Any = data.training.to(device)
        self.scales = data.scales.to(device)
        self.regularizer = None if regularizer is None else regularizer.to(device)
        self.generator = torch.Generator().manual_seed(seed)
        self.stream = data.stream
        self.batch = min(getattr(config, "batch", None) or BATCH, len(self.training))
        self.whole = getattr(config, "optimizer", "lbfgs") == "lbfgs"  # all windows at once
        if not self.whole or len(data.training) > FEW_WINDOWS:
            # L-BFGS on few is the same to the last bit unshared
            self.training = workers.shard(self.training, data.counts)
        self.resting, self.stage_from, self.stage_epoch = idle_residuals(self.model), 0.0, 0
        self.optimizer = self._optimizer(self.generator)
        windows = len(self.training)
        if self.stream is not None:
            windows = len(self.stream) // self.stream.epochs_per_pass
        self.epoch_steps = EPOCH_STEPS if self.whole else max(EPOCH_STEPS, -(-windows // self.batch))
        self.validation = Validation(self.model, data, config, self.batch, device)
        self.epoch = self.step = self.best_epoch = self.rollbacks = 0
        self.learning_rate_factor, self.seconds = 1.0, seconds
        self._since, self._pace, self._closing = self._now() - seconds, 0.0, 0.0
        self.momentum_done = not config.momentum_steps
        self.history: list[dict[str, Any]] = []
        self._measure()

    def run(self, progress: TrainingProgress) -> Status:
        """Go on until an end is reached; Ctrl-C is one and leaves the checkpoint of the last whole epoch."""
        self._since = self._now() - self.seconds
        try:
            self.save()
            if not self.momentum_done:
                self._momentum_stage(progress)
            while (end := self._end()) is None or self._release(end):
                record = self._run_epoch()
                self.seconds = record["seconds"] = self._now() - self._since
                self.history.append(record)
                if self.folder is not None:
                    self.folder.append_metrics(record)
                self.save()
                progress.epoch(record)
        except KeyboardInterrupt:
            return "interrupted"
        return end

    @staticmethod
    def _now() -> float:
        """The time [s] by one clock for all processes that fit together, for it decides what they do."""
        return workers.agreed(time.monotonic())

    def _measure(self) -> None:
        """Begin anew from the present weights: substeps, validation loss and best so far."""
        self.substeps = self.validation.substeps()
        self.best_loss = self.validation.loss(self.substeps)
        self.best_weights = copy.deepcopy(self.model.state_dict())

    def _optimizer(self, generator: torch.Generator) -> WindowOptimizer:
        """From the present weights, of those that do not rest; ``generator`` orders batches."""
        for name, parameter in self.model.named_parameters():
            parameter.requires_grad_(name not in self.resting)
        if self.whole:
            return LBFGS(self.model, self.config.weight_decay or 0.0)
        return MiniBatchAdamW(self.model, self.batch, self.config.weight_decay or 0.0, generator)

    def _momentum_stage(self, progress: TrainingProgress) -> None:
        """The weak form needs no ODE solve and brings the model near before windows are predicted.

        Kept only if it predicts the validation windows better. An interruption here starts it again on
        resumption.
        """
        before = copy.deepcopy(self.model.state_dict()), self.best_loss
        optimizer = self._optimizer(torch.Generator().manual_seed(self.seed))
        steps = self.config.momentum_steps
        for done in range(0, steps, EPOCH_STEPS):
            spent = self._spent(self._now() - self._since) / MOMENTUM_FRACTION
            if spent >= 1.0:
                break
            rate = functools.partial(self._momentum_rate, done, spent)
            loss = optimizer.run(self._momentum_loss, self.training, min(EPOCH_STEPS, steps - done), rate)
            if optimizer.stalled or not math.isfinite(loss):
                break
            progress.momentum(min(done + EPOCH_STEPS, steps), steps, loss)
        self._measure()
        if not self.best_loss < before[1]:
            self.model.load_state_dict(before[0])
            self._measure()
        self.momentum_done = True
        self.seconds = self._now() - self._since
        self.save()

    def _momentum_rate(self, done: int, spent: float, step: int) -> float:
        part = max((done + step) / self.config.momentum_steps, spent)
        return MOMENTUM_FACTOR * self._largest_rate * _schedule(part)

    def _momentum_loss(self, windows: Any) -> torch.Tensor:
        def loss(own: Windows, everywhere: Mean) -> torch.Tensor:
            return momentum_loss(self.model, own, self.scales, everywhere)

        return self.together(loss, windows) + self._penalty()

    def _rollout_loss(self, windows: Any) -> torch.Tensor:
        def loss(own: Windows, everywhere: Mean) -> torch.Tensor:
            return rollout_loss(self.stepped, own, self.scales, self.substeps, self.config.solver)

        return self.together(loss, windows) + self._penalty()

    def _end(self) -> Status | None:
        if self.epoch >= self.config.epochs or self.optimizer.stalled:
            return "finished"
        patience = min(self.config.patience, SECOND_PATIENCE) if self.stage_epoch else self.config.patience
        if self.epoch - max(self.best_epoch, self.stage_epoch) >= patience:
            return "stopped early"
        if self._spent(self.seconds + self._pace + self._closing) >= 1.0:
            return "out of time"
        return "finished" if self._done() >= self._stage_to else None

    def _spent(self, seconds: float) -> float:
        """The part of the allowed time that these seconds are; 0 where any time is allowed."""
        return 0.0 if self.config.max_minutes is None else seconds / (60 * self.config.max_minutes)

    def _run_epoch(self) -> dict[str, Any]:
        """One epoch with finite losses, after as many attempts at a lower learning rate as that takes."""
        while True:
            before = copy.deepcopy((self.model.state_dict(), self.optimizer.state_dict(), self.step))
            loss = self._train_epoch()
            trained = self._now()
            validation = self.validation.loss(self.substeps) if math.isfinite(loss) else math.nan
            self._closing = self._now() - trained
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
        }
        record |= {
            "learning_rate": self._rate(),
            "substeps": self.substeps,
            "rollbacks": self.rollbacks,
        }
        if self.epoch % PROBE_EVERY == 0:
            self.substeps = self.validation.substeps(self.substeps)
        return record

    def _train_epoch(self) -> float:
        """Mean loss over the epoch's steps; NaN as soon as a step has no finite loss or gradient."""
        windows = self.training
        if self.stream is not None:
            windows = workers.shard_of_epoch(self.stream, self.epoch).to(self.device)
        steps, start = self._steps_in_time(), self._now()
        loss = self.optimizer.run(self._rollout_loss, windows, steps, self._rate)
        self._pace = (self._now() - start) / steps
        self.step += steps
        return loss

    def _steps_in_time(self) -> int:
        """Steps of the next epoch: all, or as many as the time that is left allows at the pace so far."""
        if self.config.max_minutes is None:
            return self.epoch_steps
        if not self._pace:
            return min(self.epoch_steps, EPOCH_STEPS)
        left = 60 * self.config.max_minutes - (self._now() - self._since) - self._closing
        return max(1, min(self.epoch_steps, int(left / self._pace)))

    def _penalty(self) -> torch.Tensor | float:
        """What straying from the URDF costs."""
        return (
            0.0 if self.regularizer is None else self.config.urdf_weight * self.regularizer.loss(self.model)
        )

    @property
    def _largest_rate(self) -> float:
        return getattr(self.config, "learning_rate", None) or LEARNING_RATE

    def _rate(self, ahead: int = 0) -> float:
        """Learning rate so many steps ahead, over all steps or minutes, whichever end sooner."""
        part = (self._done(ahead) - self.stage_from) / (self._stage_to - self.stage_from)
        return self._largest_rate * self.learning_rate_factor * _schedule(part)

    def _done(self, ahead: int = 0) -> float:
        """The part of all steps or minutes that is gone so many steps ahead."""
        steps = self.config.epochs * self.epoch_steps
        return max((self.step + ahead) / steps, self._spent(self.seconds))

    @property
    def _stage_to(self) -> float:
        return FIRST_STAGE if self.resting else 1.0

    def _release(self, end: Status) -> bool:
        """Let what rests move where the stage before ended by itself; whether it does."""
        if not self.resting or end == "out of time" or not self.epoch:
            return False
        self.model.load_state_dict(self.best_weights)
        self.resting, self.stage_from, self.stage_epoch = [], self._done(), self.epoch
        self.optimizer = self._optimizer(self.generator)
        return self._end() is None

    def _roll_back(self, weights: dict[str, Any], optimizer: dict[str, Any], step: int) -> None:
        """Undo an epoch whose numbers were not finite, and halve the learning rate from here on."""
        self.rollbacks += 1
        self.model.load_state_dict(weights)
        if self.rollbacks > MAX_ROLLBACKS:
            raise RunError(
                f"losses that are not finite, after {MAX_ROLLBACKS} attempts at half the learning rate each",
                file=None if self.folder is None else self.folder.path,
                do="check units and signs of the logs"
                + ("" if self.folder is None else "; the best model so far is kept in model.pt"),
            )
        self.optimizer.load_state_dict(optimizer)
        self.step = step
        self.learning_rate_factor /= 2

    def state(self) -> dict[str, Any]:
        """All that a resumed run needs: what checkpoint.pt holds."""
        state = {name: getattr(self, name) for name in PLAIN}
        state["model"], state["optimizer"] = self.model.state_dict(), self.optimizer.state_dict()
        return state | {"generator": self.generator.get_state()}

    def save(self) -> None:
        """Write model.pt and checkpoint.pt."""
        if self.folder is not None:
            self.folder.save(self.best_weights, self.state())

    def restore(self, folder: RunFolder) -> None:
        """Continue from checkpoint.pt."""
        state = folder.load_checkpoint()
        try:
            for name in PLAIN:
                setattr(self, name, state[name])
            self.optimizer = self._optimizer(self.generator)
            self.model.load_state_dict(state["model"])
            self.optimizer.load_state_dict(state["optimizer"])
            self.generator.set_state(state["generator"])
        except (KeyError, RuntimeError, ValueError, TypeError, AttributeError) as error:
            raise RunError(
                "a checkpoint of another model", file=folder.checkpoint, do="start a new run"
            ) from error
        if self.folder is not None:  # it writes
            folder.keep_metrics(self.epoch)
        self.history = folder.read_metrics()[: self.epoch]


def _schedule(part: float) -> float:
    """The learning rate's factor when this part of training is done: a linear rise times a cosine down."""
    fall = FINAL_RATE + (1 - FINAL_RATE) * (1 + math.cos(math.pi * min(part, 1.0))) / 2
    return min(1.0, (part + 1e-3) / WARM_UP) * fall
