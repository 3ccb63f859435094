"""The loop of a training run: epochs, validation, checkpoints, and what happens when numbers blow up."""

from __future__ import annotations

import copy
import functools
import math
import time
from typing import TYPE_CHECKING, Any, Literal

import torch

from spelgen.errors import RunError
from spelgen.fitting.dataset import TrainingConfig, TrainingData
from spelgen.fitting.optimizers import Batches, Descent, WholeSet
from spelgen.fitting.progress import TrainingProgress
from spelgen.fitting.rollout import (
    INTEGRATION_SHARE,
    choose_substeps,
    integration_error,
    momentum_loss,
    rollout_loss,
)
from spelgen.fitting.run_folder import RunFolder, write_state
from spelgen.fitting.urdf_regularizer import Prior
from spelgen.logs.windows import Windows

if TYPE_CHECKING:
    from spelgen.fitting.run_folder import EmittedModel

MOMENTUM_SHARE = 0.5  # of the allowed time, what the momentum steps may take
MOMENTUM_FACTOR = 10.0  # on the learning rate of the momentum steps, which are cheap and noisy
WARM_UP = 0.02  # part of all steps over which the learning rate rises
FINAL_RATE = 0.01  # the cosine ends at this part of the learning rate
EPOCH_STEPS = 20  # at least; few windows are passed over several times between validations
PROBE = 64  # windows on which the integration error is watched
PROBE_EVERY = 5  # epochs
MAX_ROLLBACKS = 8

PLAIN = (
    "epoch", "step", "best_epoch", "best_loss", "best_weights",
    "rollbacks", "rate_factor", "seconds", "substeps", "warm",
)  # fmt: skip

Status = Literal["finished", "stopped early", "out of time", "interrupted"]


class TrainingLoop:
    """The changing state of one run; `save` writes all of it, so a resumed run repeats the same numbers."""

    def __init__(
        self,
        folder: RunFolder,
        model: EmittedModel,
        data: TrainingData,
        config: TrainingConfig,
        prior: Prior | None = None,
        stepped: EmittedModel | None = None,
    ) -> None:
        self.folder, self.config = folder, config
        self.model = model.to(config.device)
        self.stepped = stepped or self.model  # the same weights, compiled maybe
        self.training, self.validation = data.training.to(config.device), data.validation.to(config.device)
        self.scales = data.scales.to(config.device)
        self.prior = prior
        self.generator = torch.Generator().manual_seed(config.seed)
        self.batch = min(config.batch, len(self.training))
        self.stream, self.size = data.stream, data.size
        windows = len(self.training) if self.stream is None else len(self.stream) // self.stream.shares
        self.descent = self._descent(self.generator)
        self.epoch_steps = (
            EPOCH_STEPS if config.whole(self.size) else max(EPOCH_STEPS, -(-windows // self.batch))
        )
        self.probe = self.training[:: -(-len(self.training) // PROBE)]
        self.epoch = self.step = self.best_epoch = self.rollbacks = 0
        self.rate_factor, self.seconds = 1.0, 0.0
        self.warm = not config.momentum_steps
        self._measure()

    def run(self, progress: TrainingProgress) -> Status:
        """Train until an end is reached; Ctrl-C is one and leaves the checkpoint of the last whole epoch."""
        since = time.monotonic() - self.seconds
        try:
            self.save()
            if not self.warm:
                self._warm_up(progress)
            while (end := self._end()) is None:
                record = self._run_epoch()
                self.seconds = record["seconds"] = time.monotonic() - since
                self.folder.append_metrics(record)
                self.save()
                progress.epoch(record)
        except KeyboardInterrupt:
            return "interrupted"
        return end

    def _measure(self) -> None:
        """Begin anew from the present weights: substeps, validation loss and best so far."""
        self.substeps = self.config.substeps or choose_substeps(self.model, self.probe, self.scales)
        self.best_loss = self._validate()
        self.best_weights = copy.deepcopy(self.model.state_dict())

    def _descent(self, generator: torch.Generator) -> Descent:
        """From the present weights; ``generator`` orders batches."""
        decay = self.config.decay(self.size)
        if self.config.whole(self.size):
            return WholeSet(self.model, decay)
        return Batches(self.model, self.batch, decay, generator)

    def _warm_up(self, progress: TrainingProgress) -> None:
        """Momentum first: the weak form needs no ODE solve and brings the model near before windows are
        predicted.

        Kept only if it predicts the validation windows better. An interruption here starts it again on
        resumption.
        """
        before = copy.deepcopy(self.model.state_dict()), self.best_loss
        descent = self._descent(torch.Generator().manual_seed(self.config.seed))
        since, steps = time.monotonic(), self.config.momentum_steps
        for done in range(0, steps, EPOCH_STEPS):
            spent = self._spent(time.monotonic() - since) / MOMENTUM_SHARE
            if spent >= 1.0:
                break
            rate = functools.partial(self._warm_rate, done, spent)
            loss = descent.descend(self._momentum_loss, self.training, min(EPOCH_STEPS, steps - done), rate)
            if descent.stalled or not math.isfinite(loss):
                break
            progress.warm_up(min(done + EPOCH_STEPS, steps), steps, loss)
        self._measure()
        if not self.best_loss < before[1]:
            self.model.load_state_dict(before[0])
            self._measure()
        self.warm = True
        self.seconds += time.monotonic() - since
        self.save()

    def _warm_rate(self, done: int, spent: float, step: int) -> float:
        part = max((done + step) / self.config.momentum_steps, spent)
        return MOMENTUM_FACTOR * self.config.learning_rate * _schedule(part)

    def _momentum_loss(self, windows: Windows) -> torch.Tensor:
        return momentum_loss(self.model, windows, self.scales) + self._pull()

    def _rollout_loss(self, windows: Windows) -> torch.Tensor:
        return rollout_loss(self.stepped, windows, self.scales, self.substeps) + self._pull()

    def _end(self) -> Status | None:
        if self.epoch >= self.config.epochs or self.descent.stalled:
            return "finished"
        if self.epoch - self.best_epoch >= self.config.patience:
            return "stopped early"
        return "out of time" if self._spent(self.seconds) >= 1.0 else None

    def _spent(self, seconds: float) -> float:
        """The part of the allowed time that these seconds are; 0 where any time is allowed."""
        return 0.0 if self.config.max_minutes is None else seconds / (60 * self.config.max_minutes)

    def _run_epoch(self) -> dict[str, Any]:
        """One epoch with finite losses, after as many attempts at a lower learning rate as that takes."""
        while True:
            before = copy.deepcopy((self.model.state_dict(), self.descent.state_dict(), self.step))
            loss = self._train_epoch()
            validation = self._validate() if math.isfinite(loss) else math.nan
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
        record |= {"rate": self._rate(), "substeps": self.substeps, "rollbacks": self.rollbacks}
        self._watch_integration()
        return record

    def _train_epoch(self) -> float:
        """Mean loss over the epoch's steps; NaN as soon as a step has no finite loss or gradient."""
        windows = self.training
        if self.stream is not None:
            windows = self.stream.share(self.epoch).to(self.config.device)
        loss = self.descent.descend(self._rollout_loss, windows, self.epoch_steps, self._rate)
        self.step += self.epoch_steps
        return loss

    def _pull(self) -> torch.Tensor | float:
        """What straying from the URDF costs."""
        return 0.0 if self.prior is None else self.config.prior * self.prior.loss(self.model)

    def _rate(self, ahead: int = 0) -> float:
        """Learning rate so many steps ahead, over all steps or minutes, whichever end sooner."""
        steps = self.config.epochs * self.epoch_steps
        part = max((self.step + ahead) / steps, self._spent(self.seconds))
        return self.config.learning_rate * self.rate_factor * _schedule(part)

    def _validate(self) -> float:
        """Loss on the validation windows."""
        parts = self.validation.split(4 * self.batch)
        try:
            with torch.no_grad():
                losses = [
                    rollout_loss(self.model, x, self.scales, self.substeps).item() * len(x) for x in parts
                ]
        except torch.linalg.LinAlgError:
            return math.inf
        return sum(losses) / len(self.validation)

    def _roll_back(self, weights: dict[str, Any], optimiser: dict[str, Any], step: int) -> None:
        """Undo an epoch whose numbers were not finite, and halve the learning rate from here on."""
        self.rollbacks += 1
        if self.rollbacks > MAX_ROLLBACKS:
            raise RunError(
                f"losses that are not finite, after {MAX_ROLLBACKS} attempts at half the learning rate each",
                file=self.folder.path,
                do="check units and signs of the logs; the best model so far is kept in model.pt",
            )
        self.model.load_state_dict(weights)
        self.descent.load_state_dict(optimiser)
        self.step = step
        self.rate_factor /= 2

    def _watch_integration(self) -> None:
        """Take more substeps when what was learned (friction, mostly) is too stiff for the present ones."""
        if self.config.substeps is not None or self.epoch % PROBE_EVERY:
            return
        if integration_error(self.model, self.probe, self.scales, self.substeps) > INTEGRATION_SHARE:
            self.substeps = choose_substeps(self.model, self.probe, self.scales, start=2 * self.substeps)

    def save(self) -> None:
        """Write model.pt and checkpoint.pt."""
        write_state(self.folder.weights, self.best_weights)
        state = {name: getattr(self, name) for name in PLAIN}
        state["model"], state["optimiser"] = self.model.state_dict(), self.descent.state_dict()
        write_state(self.folder.checkpoint, state | {"generator": self.generator.get_state()})

    def restore(self) -> None:
        """Continue from checkpoint.pt."""
        state = self.folder.load_state(self.folder.checkpoint)
        try:
            for name in PLAIN:
                setattr(self, name, state[name])
            self.model.load_state_dict(state["model"])
            self.descent.load_state_dict(state["optimiser"])
            self.generator.set_state(state["generator"])
        except (KeyError, RuntimeError, ValueError) as error:
            raise RunError(
                "a checkpoint of another model", file=self.folder.checkpoint, do="start a new run"
            ) from error
        self.folder.keep_metrics(self.epoch)


def _schedule(part: float) -> float:
    """The learning rate's factor when this part of training is done: a linear rise times a cosine down."""
    fall = FINAL_RATE + (1 - FINAL_RATE) * (1 + math.cos(math.pi * min(part, 1.0))) / 2
    return min(1.0, (part + 1e-3) / WARM_UP) * fall
