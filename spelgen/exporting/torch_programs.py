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


def without_linear_algebra(program: torch.export.ExportedProgram) -> torch.export.ExportedProgram:
    """The program with its solutions and factorisations written out: what ONNX has no operators for."""
    table: dict[Any, Any] = torch.export.default_decompositions()
    table[torch.ops.aten.linalg_solve.default] = _solve
    table[torch.ops.aten.linalg_cholesky_ex.default] = _cholesky_ex
    return program.run_decompositions(table)


def _solve(matrix: Tensor, right: Tensor, *, left: bool = True) -> Tensor:
    """By Gauss and Jordan's elimination without pivoting, which positive definite matrices do not need."""
    n = matrix.shape[-1]
    rows = torch.cat([matrix.expand(*right.shape[:-2], n, n), right], dim=-1)
    unit = torch.eye(n, dtype=matrix.dtype)
    for k in range(n):
        row = rows[..., k : k + 1, :] / rows[..., k : k + 1, k : k + 1]
        rows = rows - (rows[..., :, k : k + 1] - unit[:, k : k + 1]) * row
    return rows[..., n:]


def _cholesky_ex(matrix: Tensor, *, upper: bool = False, check_errors: bool = False) -> tuple[Tensor, Tensor]:
    """Whether it is positive definite is all that is asked of it: info is 0 where every pivot is positive."""
    rest, pivots = matrix, []
    for k in range(matrix.shape[-1]):
        pivot = rest[..., :1, :1]
        pivots.append(pivot[..., 0])
        if k < matrix.shape[-1] - 1:
            rest = rest[..., 1:, 1:] - rest[..., 1:, :1] * (rest[..., :1, 1:] / pivot)
    definite = (torch.cat(pivots, dim=-1) > 0).all(dim=-1)
    return matrix, torch.logical_not(definite).to(torch.int32)
