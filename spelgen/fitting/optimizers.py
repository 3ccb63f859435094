"""Optimizers of window losses: AdamW on batches, or L-BFGS on all windows at once if there are few.

The gradient of a few hundred windows takes no longer than the gradient of a batch. The gradient of all windows has no
sampling noise, so L-BFGS can estimate the curvature and converges to many digits. Accuracy to many digits matters for
short logs and for simulated logs without noise.
"""

import inspect
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from spelgen.fitting.run_record import Content
from spelgen.fitting.tuning import TUNING
from spelgen.logs.windows import Windows

Loss = Callable[[Windows], Tensor]
LearningRate = Callable[[int], float]
# Function that yields the terms of a loss one after another: only one term's graph of derivatives is in memory.
Summands = Callable[[], Iterable[Tensor]]


class WindowOptimizer(ABC):
    """Optimizer of the weights of a model that require a gradient when the optimizer is created.

    Subclasses store their own state in torch's parameter groups, since torch's `state_dict` contains these groups.
    """

    _optimizer: torch.optim.Optimizer

    @abstractmethod
    def run(self, loss: Loss, windows: Windows, steps: int, learning_rate: LearningRate) -> float:
        """Take optimizer steps and return the mean loss; NaN if a loss is not finite.

        Args:
            loss: function that returns the loss of a batch of windows.
            windows: training windows.
            steps: number of steps.
            learning_rate: function that returns the learning rate of step number 0, 1, ...
        """

    @property
    def stalled(self) -> bool:
        """Whether the last calls of `run` no longer lowered the loss; False for optimizers without this test."""
        return False

    def state_dict(self) -> Content:
        """Return the state of the optimizer, from which a run is resumed."""
        return self._optimizer.state_dict()

    def load_state_dict(self, state: Content) -> None:
        """Restore the state of the optimizer from the result of `state_dict`."""
        self._optimizer.load_state_dict(state)


def _trainable(model: torch.nn.Module) -> tuple[list[torch.nn.Parameter], list[torch.nn.Parameter]]:
    """Return two lists of a model's parameters: all that require a gradient, and the matrices among these.

    Only matrices have weight decay.
    """
    parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
    return parameters, [parameter for parameter in parameters if parameter.dim() > 1]


class MiniBatchAdamW(WindowOptimizer):
    """AdamW on batches in random order.

    Vectors (biases, constants, viscous friction) have a higher learning rate than matrices, and no weight decay.
    """

    def __init__(
        self, model: torch.nn.Module, batch: int, weight_decay: float, generator: torch.Generator
    ) -> None:
        self._parameters, matrices = _trainable(model)
        self._batch, self._generator = batch, generator
        # Vectors have no weight decay. They contain the constants of friction and mass, which have physical units:
        # weight decay would bias them towards zero.
        vectors = [parameter for parameter in self._parameters if parameter.dim() <= 1]
        self._optimizer = torch.optim.AdamW(
            [
                {"params": matrices, "weight_decay": weight_decay, "factor": 1.0},
                {"params": vectors, "weight_decay": 0.0, "factor": TUNING.number_factor},
            ]
        )

    def run(self, loss: Loss, windows: Windows, steps: int, learning_rate: LearningRate) -> float:
        """Take AdamW steps on random batches of windows; return the mean loss, NaN if a loss is not finite."""
        rows, size = steps * self._batch, len(windows)
        # Several random permutations of all windows are concatenated and cut into batches, so that all windows are used
        # about equally often.
        passes = [torch.randperm(size, generator=self._generator) for _ in range(-(-rows // size))]
        # The sum of the losses remains on their device, since float() in each step would wait for a GPU.
        total: Tensor | float = 0.0
        for step, batch in enumerate(torch.cat(passes)[:rows].split(self._batch)):
            for group in self._optimizer.param_groups:
                group["lr"] = learning_rate(step) * group["factor"]
            total = total + self._step(loss, windows[batch.to(windows.q.device)])
        mean = float(total) / steps
        return mean if math.isfinite(mean) else math.nan

    def _step(self, loss: Loss, windows: Windows) -> Tensor | float:
        """Take a step on a batch; return the loss before it, (), or NaN if this loss or the gradient is not finite."""
        self._optimizer.zero_grad()
        try:
            value = loss(windows)
        except torch.linalg.LinAlgError:  # LinAlgError: the rollout diverged
            return math.nan
        value.backward()
        norm = torch.nn.utils.clip_grad_norm_(self._parameters, TUNING.gradient_norm)
        self._optimizer.step()
        # If the gradient is not finite, 0 * norm is NaN, and so is the returned loss. An explicit test of the norm
        # would wait for a GPU.
        return value.detach() + 0.0 * norm


class _EagerLBFGS(torch.optim.LBFGS):
    """L-BFGS of torch with undecorated methods: torch's decorator imports the compiler, which takes 5 s."""

    add_param_group = inspect.unwrap(torch.optim.Optimizer.add_param_group)
    zero_grad = inspect.unwrap(torch.optim.Optimizer.zero_grad)
    load_state_dict = inspect.unwrap(torch.optim.Optimizer.load_state_dict)
    state_dict = inspect.unwrap(torch.optim.Optimizer.state_dict)


class LBFGS(WindowOptimizer):
    """L-BFGS (Liu and Nocedal, Math. Programming 45, 1989) with a strong-Wolfe line search on all windows.

    In `run`, ``steps`` is the maximum number of evaluations of the loss, and the learning rate is not used.
    weight_decay: factor of the penalty, which is half the sum of squares of all matrices and is added to the loss.
    """

    _optimizer: torch.optim.LBFGS

    def __init__(self, model: torch.nn.Module, weight_decay: float) -> None:
        self._parameters, self._matrices = _trainable(model)
        self._decay, self._finite = weight_decay, True
        self._optimizer = _EagerLBFGS(
            self._parameters,
            history_size=TUNING.lbfgs_history,
            line_search_fn="strong_wolfe",
            # The tolerances are smaller than torch's defaults, since simulated logs are fitted to many digits. The
            # property `stalled` ends the fit.
            tolerance_grad=1e-12,
            tolerance_change=1e-15,
        )
        # `last` is (loss, loss + penalty) at the end of the previous call. `waits` is the number of successive calls
        # that lowered neither.
        self._optimizer.param_groups[0].update(last=(math.inf, math.inf), waits=0)

    def run(self, loss: Loss, windows: Windows, steps: int, learning_rate: LearningRate) -> float:
        """Minimise the loss of all windows; return the loss at the end, NaN if no evaluation was finite."""
        return self.minimise(lambda: [loss(windows)], steps)

    def minimise(self, summands: Summands, steps: int) -> float:
        """Minimise a sum of losses plus the penalty of the weight decay; return the sum at the end.

        The result does not include the penalty; it is NaN if no evaluation was finite. Only one summand at a time is in
        memory with its graph of derivatives. steps: maximum number of evaluations of the sum.
        """
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
        # A decrease of the loss or of the penalised loss counts as progress: a decrease of the penalty may raise the
        # loss.
        progress = loss <= TUNING.lbfgs_stalled * last or penalised <= TUNING.lbfgs_stalled * last_penalised
        group["last"], group["waits"] = (loss, penalised), 0 if progress else group["waits"] + 1
        return loss

    @property
    def stalled(self) -> bool:
        """Whether the last two calls of the optimizer lowered neither the loss nor the penalised loss significantly."""
        waits: int = self._optimizer.param_groups[0]["waits"]
        return waits > 1

    def _evaluated(self, summands: Summands) -> Tensor:
        """Compute the gradients of the penalised loss; return this loss, (), or a large number if it is not finite.

        The loss is also replaced by the large number if a gradient is not finite.
        """
        self._optimizer.zero_grad()
        try:
            value = torch.zeros((), dtype=torch.float64)
            for number, summand in enumerate(summands()):
                if number == 0:
                    summand = summand + self._penalty()
                # Gradients of the summands accumulate, so that only one summand's graph is in memory.
                summand.backward()
                value = value + summand.detach()
            gradients = torch.cat([x.grad.flatten() for x in self._parameters if x.grad is not None])
            if value.isfinite() and gradients.isfinite().all():
                self._finite = True
                return value
        except torch.linalg.LinAlgError:
            pass
        self._optimizer.zero_grad()
        return torch.tensor(TUNING.too_large, dtype=torch.float64)

    def _penalty(self) -> Tensor | float:
        return 0.5 * self._decay * sum(weight.square().sum() for weight in self._matrices)


def minimise(model: torch.nn.Module, summands: Summands, evaluations: int, weight_decay: float = 0.0) -> int:
    """Minimize a loss over the weights of a model by `LBFGS`; return the number of evaluations.

    Args:
        model: model whose weights are fitted, if they require a gradient.
        summands: function that yields the terms of the loss.
        evaluations: maximum number of evaluations of the loss, rounded up to a multiple of `TUNING.lbfgs_call`.
        weight_decay: factor of half the sum of squares of all matrices, which is added to the loss.
    """
    optimizer, count = LBFGS(model, weight_decay), 0
    while count < evaluations and not optimizer.stalled:
        optimizer.minimise(summands, TUNING.lbfgs_call)
        count += TUNING.lbfgs_call
    return count
