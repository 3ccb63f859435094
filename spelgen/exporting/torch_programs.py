"""Programs of torch.export for the entry points of a trained model: any batch size, weights as constants."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from spelgen.dynamics.prepared import PreparedModel
from spelgen.exporting.entry_points import ENTRY_POINTS

PROGRAMS: dict[str, Callable[..., Tensor]] = {
    "inverse_dynamics": PreparedModel.inverse_dynamics,
    "forward_dynamics": PreparedModel.forward_dynamics,
    "mass_matrix": PreparedModel.mass_matrix,
    "bias": PreparedModel.bias,
    "gravity": PreparedModel.gravity,
    "friction": PreparedModel.friction_torque,
}
"""The entry points that have a program, and the methods that compute them."""


class _Program(nn.Module):
    def __init__(self, model: PreparedModel, name: str) -> None:
        super().__init__()
        self._model, self._function = model, PROGRAMS[name]
        self._has_memory = "z" in program_inputs(model, name)

    def forward(self, *inputs: Tensor) -> Tensor:
        if self._has_memory:
            *states, z = inputs
            return self._function(self._model, *states, z.reshape(-1, self._model.n, self._model.elements))
        return self._function(self._model, *inputs)


def export_program(
    model: PreparedModel, name: str, *, flat_memory: bool = False
) -> torch.export.ExportedProgram:
    """Return the program of an entry point; the first dimension of its inputs is the batch.

    z, the memory of friction, is (batch, n, K), or (batch, n K) where ``flat_memory``; the other inputs are (batch, n).
    """
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(program_inputs(model, name), (model.n,))
    if "z" in shapes:
        shapes["z"] = (model.n * model.elements,) if flat_memory else (model.n, model.elements)
    # a batch of two: torch.export would take one for a constant
    inputs = tuple(torch.full((2, *shape), 0.1, dtype=torch.float64) for shape in shapes.values())
    batch = tuple({0: torch.export.Dim("batch")} for _ in inputs)
    return torch.export.export(_Program(model, name), inputs, dynamic_shapes=(batch,))


def program_inputs(model: PreparedModel, name: str) -> tuple[str, ...]:
    """Return the names of an entry point's inputs; z is among them where friction has a memory."""
    inputs = ENTRY_POINTS[name].inputs
    return inputs if model.elements else tuple(key for key in inputs if key != "z")


def program_output(name: str) -> str:
    """Return the name of an entry point's only output."""
    return ENTRY_POINTS[name].outputs[0][0]
