"""Optimizers: AdamW on batches, or L-BFGS on all windows at once where these are few.

The gradient of a few hundred windows costs no more than that of a batch and is exact, so curvature pays: simulated
logs have many digits to find, and an engineer's first log has few windows.
"""

from __future__ import annotations

import inspect
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable

import torch

from spelgen.fitting.run_record import Content
from spelgen.fitting.tuning import OptimizerTuning
from spelgen.logs.windows import Windows

TUNING = OptimizerTuning()

Loss = Callable[[Windows], torch.Tensor]
LearningRate = Callable[[int], float]
Summands = Callable[[], Iterable[torch.Tensor]]  # of a loss; one at a time is in memory


class WindowOptimizer(ABC):
    """Move those weights of one model that required a gradient when this was made.

    What a resumed run needs beside the state of torch's optimizer is kept in its groups, which that saves.
    """

    _optimizer: torch.optim.Optimizer

    @abstractmethod
    def run(self, loss: Loss, windows: Windows, steps: int, learning_rate: LearningRate) -> float:
        """Take ``steps`` steps on ``loss`` and return the mean loss, NaN as soon as one is not finite.

        The learning rates are learning_rate(0), learning_rate(1) ...
        """

    @property
    def stalled(self) -> bool:
        """Whether there is no way down from here."""
        return False

    def state_dict(self) -> Content:
        """All that a resumed run needs."""
        return self._optimizer.state_dict()

    def load_state_dict(self, state: Content) -> None:
        """Go on from a ``state_dict``."""
        self._optimizer.load_state_dict(state)


def _moving(model: torch.nn.Module) -> tuple[list[torch.nn.Parameter], list[torch.nn.Parameter]]:
    """Return the parameters that require a gradient, and those of them that are weights, which may decay."""
    parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
    return parameters, [parameter for parameter in parameters if parameter.dim() > 1]


class MiniBatchAdamW(WindowOptimizer):
    """Step by AdamW on batches in random order.

    Single numbers (constants, viscous friction) learn faster than weights and do not decay.
    """

    def __init__(
        self, model: torch.nn.Module, batch: int, weight_decay: float, generator: torch.Generator
    ) -> None:
        self._parameters, weights = _moving(model)
        self._batch, self._generator = batch, generator
        numbers = [parameter for parameter in self._parameters if parameter.dim() <= 1]
        self._optimizer = torch.optim.AdamW(
            [
                {"params": weights, "weight_decay": weight_decay, "factor": 1.0},
                {"params": numbers, "weight_decay": 0.0, "factor": TUNING.number_factor},
            ]
        )

    def run(self, loss: Loss, windows: Windows, steps: int, learning_rate: LearningRate) -> float:
        """See ``WindowOptimizer``."""
        rows, size = steps * self._batch, len(windows)
        passes = [torch.randperm(size, generator=self._generator) for _ in range(-(-rows // size))]
        total: torch.Tensor | float = 0.0  # on the device: a GPU is not waited for between steps
        for step, batch in enumerate(torch.cat(passes)[:rows].split(self._batch)):
            for group in self._optimizer.param_groups:
                group["lr"] = learning_rate(step) * group["factor"]
            total = total + self._step(loss, windows[batch.to(windows.q.device)])
        mean = float(total) / steps
        return mean if math.isfinite(mean) else math.nan

    def _step(self, loss: Loss, windows: Windows) -> torch.Tensor | float:
        """The loss before the step; NaN where it or its gradient is not finite, and the weights are not either then."""
        self._optimizer.zero_grad()
        try:
            value = loss(windows)
        except torch.linalg.LinAlgError:  # numbers blew up within the rollout
            return math.nan
        value.backward()
        norm = torch.nn.utils.clip_grad_norm_(self._parameters, TUNING.gradient_norm)
        self._optimizer.step()
        return value.detach() + 0.0 * norm


class _EagerLBFGS(torch.optim.LBFGS):
    """Step as torch's do, without the compiler that they import first: 5 s of a fit that may take 10."""

    add_param_group = inspect.unwrap(torch.optim.Optimizer.add_param_group)
    zero_grad = inspect.unwrap(torch.optim.Optimizer.zero_grad)
    load_state_dict = inspect.unwrap(torch.optim.Optimizer.load_state_dict)
    state_dict = inspect.unwrap(torch.optim.Optimizer.state_dict)


class LBFGS(WindowOptimizer):
    """L-BFGS (Liu and Nocedal, Math. Programming 45, 1989) with a strong-Wolfe line search on all windows.

    A step is an evaluation. weight_decay: factor of half the sum of squares of all weights, which is added to the loss;
    the learning rate is not used.
    """

    _optimizer: torch.optim.LBFGS

    def __init__(self, model: torch.nn.Module, weight_decay: float) -> None:
        self._parameters, self._weights = _moving(model)
        self._decay, self._finite = weight_decay, True
        self._optimizer = _EagerLBFGS(
            self._parameters,
            history_size=TUNING.history,
            line_search_fn="strong_wolfe",
            tolerance_grad=1e-12,
            tolerance_change=1e-15,
        )
        # the loss where the call before ended, also with the penalty; and how many in a row found next to nothing
        self._optimizer.param_groups[0].update(last=(math.inf, math.inf), waits=0)

    def run(self, loss: Loss, windows: Windows, steps: int, learning_rate: LearningRate) -> float:
        """See ``WindowOptimizer``; the loss where it ends, NaN where no evaluation was finite."""
        return self.minimise(lambda: [loss(windows)], steps)

    def minimise(self, summands: Summands, steps: int) -> float:
        """As ``run``, of a loss that is the sum of its summands."""
        group = self._optimizer.param_groups[0]
        group["max_iter"], group["max_eval"] = steps, steps
        self._finite = False
        self._optimizer.step(lambda: self._evaluated(summands))
        if not self._finite:
            return math.nan
        try:
            with torch.no_grad():
                total = torch.stack(list(summands())).sum()
                penalised = (total + self._penalty()).item()
        except torch.linalg.LinAlgError:
            return math.nan
        loss, (last, last_penalised) = total.item(), group["last"]
        gained = loss <= TUNING.stalled * last or penalised <= TUNING.stalled * last_penalised
        group["last"], group["waits"] = (loss, penalised), 0 if gained else group["waits"] + 1
        return loss

    @property
    def stalled(self) -> bool:
        """Whether two calls in a row found next to nothing."""
        waits: int = self._optimizer.param_groups[0]["waits"]
        return waits > 1

    def _evaluated(self, summands: Summands) -> torch.Tensor:
        self._optimizer.zero_grad()
        try:
            value = torch.zeros((), dtype=torch.float64)
            for number, summand in enumerate(summands()):
                if number == 0:
                    summand = summand + self._penalty()
                summand.backward()
                value = value + summand.detach()
            slopes = torch.cat([x.grad.flatten() for x in self._parameters if x.grad is not None])
            if value.isfinite() and slopes.isfinite().all():
                self._finite = True
                return value
        except torch.linalg.LinAlgError:
            pass
        self._optimizer.zero_grad()
        return torch.tensor(TUNING.too_large, dtype=torch.float64)

    def _penalty(self) -> torch.Tensor | float:
        return 0.5 * self._decay * sum(weight.square().sum() for weight in self._weights)


def minimise(model: torch.nn.Module, summands: Summands, evaluations: int, weight_decay: float = 0.0) -> int:
    """Move the model's weights down the sum of ``summands`` by ``LBFGS``; return how many evaluations that took.

    It ends where that stalls, or after about so many evaluations.
    """
    optimizer, count = LBFGS(model, weight_decay), 0
    while count < evaluations and not optimizer.stalled:
        optimizer.minimise(summands, TUNING.call)
        count += TUNING.call
    return count
