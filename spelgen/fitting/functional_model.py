"""Evaluation of a model with other parameters than its own, as a differentiable function of these parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeVar

import torch
from torch.func import functional_call

from spelgen.emission.assemble import ArmModel

NamedTensors = Mapping[str, torch.Tensor]
"""Tensors by the names of a model's parameters and buffers."""

Result = TypeVar("Result")


class _Caller(torch.nn.Module):
    """Module whose `forward` applies any function to a model, since `functional_call` calls only `forward`."""

    def __init__(self, model: ArmModel) -> None:
        super().__init__()
        self.model = model

    def forward(self, function: Callable[[ArmModel], Result]) -> Result:
        return function(self.model)


def evaluate_with(
    model: ArmModel, parameters: NamedTensors, function: Callable[[ArmModel], Result]
) -> Result:
    """Return function(model) with the given parameters; all other parameters of the model keep their values."""
    named = {f"model.{name}": tensor for name, tensor in parameters.items()}
    result: Result = functional_call(_Caller(model), named, (function,))
    return result
