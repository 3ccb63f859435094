"""Windows that a model is fitted to, what moves its weights, and what is added to any loss of them."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING

import torch

from spelgen.fitting.dataset import TrainingData
from spelgen.fitting.optimizers import LBFGS, MiniBatchAdamW, WindowOptimizer
from spelgen.fitting.urdf_regularizer import UrdfRegularizer
from spelgen.settings.fits import DEFAULTS, WindowConfig
from spelgen.settings.tuning.fitting import WindowTuning

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

TUNING = WindowTuning()


class Clock:
    """The time of a fit. max_minutes: allowed; None: any. spent: before [s]."""

    def __init__(self, max_minutes: float | None, spent: float) -> None:
        self.allowed = math.inf if max_minutes is None else 60 * max_minutes
        self._start = time.monotonic() - spent

    @property
    def seconds(self) -> float:
        """Time of the fit so far [s]."""
        return time.monotonic() - self._start

    def fraction(self, seconds: float) -> float:
        """Return how much of the allowed time these seconds are; 0 where any time is allowed."""
        if math.isinf(self.allowed):
            return 0.0
        return math.inf if not self.allowed else seconds / self.allowed


class WindowProblem:
    """A model on a device, the windows that it is fitted to, and the regularizer towards its URDF.

    config: a resolved one. whole: whether a step takes all windows at once.
    """

    def __init__(
        self,
        model: EmittedModel,
        data: TrainingData,
        config: WindowConfig,
        device: str = "cpu",
        regularizer: UrdfRegularizer | None = None,
    ) -> None:
        self.model = model.to(device)
        self.config = config
        self.training = data.training.to(device)
        self.scales = data.scales.to(device)
        self.regularizer = None if regularizer is None else regularizer.to(device)
        self.whole = config.optimizer == "lbfgs"
        self.batch = min(config.batch or DEFAULTS.batch, len(self.training))
        self.call_steps = TUNING.epoch_steps
        self.epoch_steps = TUNING.epoch_steps
        if not self.whole:
            self.epoch_steps = max(TUNING.epoch_steps, -(-len(self.training) // self.batch))

    def optimizer(self, generator: torch.Generator) -> WindowOptimizer:
        """Return a new one from the present weights, of those that require a gradient; ``generator`` orders batches."""
        decay = self.config.weight_decay or 0.0
        if self.whole:
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
