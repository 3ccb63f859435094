"""A model's right-hand side compiled by torch, for training steps: fewer and larger operations on small matrices,
on a GPU as CUDA graphs.

Only `port_hamiltonian_rhs` is compiled: it is nearly all of a step, the same whatever the window's length and the
number of substeps, so that it is compiled once.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from spelgen.errors import RunError
from spelgen.fitting.rollout import rollout_loss

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel
    from spelgen.fitting.rollout import LossScales
    from spelgen.logs.windows import Windows

OPTIONS: dict[str, dict[str, Any]] = {
    # torch would compile small programs to find out whether the instructions that the processor reports can be used
    "cpu": {"cpp.vec_isa_ok": True},
    # recorded once and replayed: to launch such small kernels one by one takes longer than to run them
    "cuda": {"triton.cudagraphs": True},
}
CURE = "install a C++ compiler (g++), or train without compile=true"


class Compiled:
    """A model that is compiled where it pays; the rest is the model's own."""

    def __init__(self, model: EmittedModel) -> None:
        self._model = model
        device = next(model.parameters()).device.type
        self._rhs = torch.compile(model.port_hamiltonian_rhs, dynamic=False, options=OPTIONS.get(device))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._model, name)

    def prepare(self, definite: bool = True) -> Any:
        """As the model's. Called once a step, so that CUDA graphs know when the last one's memory is free."""
        torch.compiler.cudagraph_mark_step_begin()
        return self._model.prepare(definite)

    def port_hamiltonian_rhs(
        self,
        q: torch.Tensor,
        p: torch.Tensor,
        tau: torch.Tensor | None,
        prepared: Any,
        *state: torch.Tensor | None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """As the model's. A window's first q, a measured one, is made like all later ones: else it would be compiled
        for by itself, which doubles the wait.
        """
        q = q.contiguous()
        if torch.is_grad_enabled() and not q.requires_grad:
            q = q.detach().requires_grad_()
        return self._rhs(q, p, tau, prepared, *state)


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
    result: EmittedModel = ready
    return result
