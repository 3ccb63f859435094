"""Steps on the weak form of the equations, which needs no ODE solve and brings a model near its windows."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from spelgen.fitting.rollout import momentum_loss
from spelgen.fitting.validation import Measured, measure
from spelgen.fitting.window.problem import TUNING, Clock, WindowProblem
from spelgen.logs.windows import Windows

if TYPE_CHECKING:
    from spelgen.fitting.progress import TrainingProgress
    from spelgen.fitting.validation import Validation


def momentum_stage(
    problem: WindowProblem,
    validation: Validation,
    start: Measured,
    clock: Clock,
    progress: TrainingProgress,
    seed: int,
) -> Measured:
    """Take the momentum steps from ``start``, where the model is; return the better of both ends, which it then has.

    An interruption here starts the stage again on resumption.
    """
    steps, model = problem.config.momentum_steps, problem.model
    optimizer = problem.optimizer(torch.Generator().manual_seed(seed))

    def loss(windows: Windows) -> torch.Tensor:
        return momentum_loss(model, windows, problem.scales) + problem.penalty()

    for done in range(0, steps, problem.call_steps):
        spent = clock.fraction(clock.seconds) / TUNING.momentum_fraction
        if spent >= 1.0:
            break

        def rate(step: int, done: int = done, spent: float = spent) -> float:
            return TUNING.momentum_factor * problem.learning_rate(max((done + step) / steps, spent))

        value = optimizer.run(loss, problem.training, min(problem.call_steps, steps - done), rate)
        if optimizer.stalled or not math.isfinite(value):
            break
        progress.momentum(min(done + problem.call_steps, steps), steps, value)
    end = measure(model, validation)
    if end.loss < start.loss:
        return end
    model.load_state_dict(start.weights)
    return start
