"""A trained model's entry points as programs of torch.export: any batch size, nothing that depends on weights alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from spelgen.dynamics.prepared import PreparedModel

PROGRAMS: dict[str, tuple[str, tuple[str, ...], str]] = {
    "inverse_dynamics": ("inverse_dynamics", ("q", "qd", "qdd"), "tau"),
    "forward_dynamics": ("forward_dynamics", ("q", "qd", "tau"), "qdd"),
    "mass_matrix": ("mass_matrix", ("q",), "mass"),
    "bias": ("bias", ("q", "qd"), "bias"),
    "gravity": ("gravity", ("q",), "gravity"),
    "friction": ("friction_torque", ("q", "qd"), "friction"),
}
"""By entry point: the method of ``PreparedModel``, its inputs, (batch, n) each, and its output."""

_WITH_FRICTION = ("inverse_dynamics", "forward_dynamics", "friction")


class _Program(nn.Module):
    def __init__(self, function: Callable[..., Tensor]) -> None:
        super().__init__()
        self._function = function

    def forward(self, *inputs: Tensor) -> Tensor:
        return self._function(*inputs)


def export_program(model: PreparedModel, name: str) -> torch.export.ExportedProgram:
    """An entry point; the first dimension of its inputs is the batch."""
    inputs = program_inputs(model, name)
    batch = torch.export.Dim("batch")
    sizes = [(2, model.n, model.elements) if each == "z" else (2, model.n) for each in inputs]
    given = tuple(0.1 * torch.ones(size, dtype=torch.float64) for size in sizes)
    shapes: Any = (tuple({0: batch} for _ in inputs),)
    return torch.export.export(_Program(getattr(model, PROGRAMS[name][0])), given, dynamic_shapes=shapes)


def program_inputs(model: PreparedModel, name: str) -> tuple[str, ...]:
    """An entry point's inputs: z, (batch, n, K), is among them where friction has a memory and a part in it."""
    _, inputs, _ = PROGRAMS[name]
    return (*inputs, "z") if model.elements and name in _WITH_FRICTION else inputs
