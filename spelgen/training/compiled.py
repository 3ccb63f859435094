"""A model's right-hand side compiled by torch, for training steps: fewer and larger operations on small matrices.

Only `rates` is compiled: it is nearly all of a step, and it stays the same whatever the window's length and the
number of substeps, so that it is compiled once.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from spelgen.errors import RunError
from spelgen.training.rollout import rollout_loss

if TYPE_CHECKING:
    from spelgen.data.windows import Windows
    from spelgen.training.rollout import LossScales
    from spelgen.training.runs import EmittedModel

# torch would compile small programs to find out whether the instructions that the processor reports can be used
OPTIONS: dict[str, Any] = {"cpp.vec_isa_ok": True}
CURE = "install a C++ compiler (g++), or train without --compile"


class Compiled:
    """A model that is compiled where it pays; the rest is the model's own."""

    def __init__(self, model: EmittedModel) -> None:
        self._model = model
        self._rates = torch.compile(model.rates, dynamic=False, options=OPTIONS)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._model, name)

    def rates(
        self, q: torch.Tensor, p: torch.Tensor, tau: torch.Tensor | None, prepared: Any
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """As the model's."""
        return self._rates(q, p, tau, prepared)


def compiled(model: EmittedModel, windows: Windows, scales: LossScales) -> EmittedModel:
    """Return the model with its right-hand side compiled for a batch of as many windows, forward and backward.

    Weights are shared and keep no gradient of the trial. Raises RunError where torch cannot compile here.
    """
    ready: Any = Compiled(model)
    try:
        rollout_loss(ready, windows, scales, 1).backward()
    except Exception as error:  # of the compiler's many layers, each with kinds of its own
        cause = error.__cause__ or error
        reason = (str(cause).strip() or type(cause).__name__).splitlines()[0]
        raise RunError(f"a right-hand side that torch cannot compile ({reason})", do=CURE) from error
    model.zero_grad()
    return ready
