"""A model under other weights than its own, as torch's functions of functions need it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch.func import functional_call

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel

Weights = Mapping[str, torch.Tensor]


class _Evaluated(torch.nn.Module):
    def __init__(self, model: ArmModel) -> None:
        super().__init__()
        self.model = model

    def forward(self, function: Callable[[Any], Any]) -> Any:
        return function(self.model)


def under_weights(model: ArmModel, weights: Weights, function: Callable[[Any], Any]) -> Any:
    """Return what a function gives for the model under weights that stand in for its own, by their names there."""
    named = {f"model.{name}": weight for name, weight in weights.items()}
    return functional_call(_Evaluated(model), named, (function,))
