"""--to onnx: the programs of torch.export as ONNX files, any batch size, float64."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import ClassVar, NamedTuple, cast

import numpy as np
import onnx
import onnxruntime
import onnxscript
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from spelgen.dynamics.prepared import PreparedModel
from spelgen.exporting.describe import Trained
from spelgen.exporting.entry_points import chosen
from spelgen.exporting.exported import Exported, folder_export
from spelgen.exporting.parity import Called, Values, check_parity
from spelgen.exporting.torch_export import PROGRAMS, export_program, program_inputs, program_output
from spelgen.exporting.tuning import TUNING


def export_onnx(trained: Trained) -> Exported:
    """Return an .onnx for each entry point. Raises RunError where ONNX Runtime and the model differ."""
    model = trained.model.prepared()
    models, files = {}, {}
    for name in chosen(trained.entries, PROGRAMS):
        models[name] = files[f"{name}.onnx"] = onnx_model(model, name)
    parity = check_parity(called_by_onnx(models), trained, list(models), TUNING.onnx_tolerance)
    checked = f"Checked when exported, by ONNX Runtime {onnxruntime.__version__}: {parity.summary}."
    use = (
        "onnxruntime.InferenceSession('forward_dynamics.onnx').run(['qdd'], {'q': q, 'qd': qd, 'tau': tau}), "
        "float64 (batch, n), any batch."
    )
    size = model.n * model.elements
    about = f"one file an entry point: {', '.join(models)}."
    if size:
        about = f"z, friction's memory, is (batch, {size}); {about}"
    return folder_export(trained, "onnx", "in ONNX", files, use=use, about=about, checked=checked)


def onnx_model(model: PreparedModel, name: str) -> bytes:
    """Return the serialised ONNX model of an entry point."""
    with _silent_exporter():
        with _WrittenOut():
            program = export_program(model, name, flat_memory=True)
        exported = torch.onnx.export(
            program,
            dynamo=True,
            input_names=program_inputs(model, name),
            output_names=[program_output(name)],
            custom_translation_table={torch.ops.aten.scalar_tensor.default: _scalar_tensor},
            verbose=False,
        )
    assert exported is not None
    content = exported.model_proto
    # torch's own names for each node: two thirds of the file
    for described in (content, content.graph, *content.graph.node):
        described.ClearField("metadata_props")
    serialised: bytes = content.SerializeToString()
    return serialised


@contextmanager
def _silent_exporter() -> Iterator[None]:
    """Silence torch, which tells that torchvision is absent, and that it uses what is deprecated."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    finally:
        logger.setLevel(level)


def _cross(left: Tensor, right: Tensor, *, dim: int) -> Tensor:
    """Return the cross product of vectors along a dimension."""
    following, last = torch.tensor([1, 2, 0]), torch.tensor([2, 0, 1])
    forward = left.index_select(dim, following) * right.index_select(dim, last)
    return forward - left.index_select(dim, last) * right.index_select(dim, following)


def _solve(matrix: Tensor, right: Tensor) -> Tensor:
    """Return matrix^-1 right by Gauss and Jordan; M is positive definite and needs no pivoting."""
    n = matrix.shape[-1]  # a constant of the program, so that the loop is written out
    identity = torch.eye(n, dtype=matrix.dtype)
    # a matrix of inputs has no batch, nor has a right side that is the identity
    batch = torch.broadcast_shapes(matrix.shape[:-2], right.shape[:-2])
    rows = torch.cat([matrix.expand(*batch, n, n), right.expand(*batch, *right.shape[-2:])], dim=-1)
    for k in range(n):
        pivot = rows[..., k : k + 1, :]
        pivot = pivot / pivot[..., k : k + 1]
        rows = rows - (rows[..., k : k + 1] - identity[:, k : k + 1]) * pivot
    return rows[..., n:]


def _solve_triangular(matrix: Tensor, right: Tensor, *, upper: bool, unitriangular: bool) -> Tensor:
    """Return matrix^-1 right, of a matrix whose other triangle is zero and whose diagonal stands for ones."""
    identity = torch.eye(matrix.shape[-1], dtype=matrix.dtype)
    return _solve(matrix - matrix * identity + identity, right)


class _Cholesky(NamedTuple):
    L: Tensor
    info: Tensor


def _cholesky_ex(matrix: Tensor) -> _Cholesky:
    """Return in place of a Cholesky factor the matrix, and 1 where it is not positive definite, else 0.

    Networks of M use the second alone.
    """
    rows = matrix
    info = torch.zeros(matrix.shape[:-2], dtype=torch.int32)
    for k in range(matrix.shape[-1]):
        pivot = rows[..., k : k + 1, k : k + 1]
        # a pivot that is NaN counts as not positive
        info = torch.where(pivot[..., 0, 0] > 0, info, 1)
        rows = rows - rows[..., k : k + 1] * rows[..., k : k + 1, :] / pivot
    return _Cholesky(matrix, info)


def _scalar_tensor(s: float, dtype: int = onnx.TensorProto.DOUBLE, **options: object) -> onnxscript.ir.Value:
    """Return a constant: torch's own translation rounds it to float32 first, an error of 1e-8 in networks."""
    value = np.array(s, dtype=onnx.helper.tensor_dtype_to_np_dtype(dtype))
    constant = onnxscript.opset18.Constant(value=onnx.numpy_helper.from_array(value))
    return cast("onnxscript.ir.Value", constant)


def _softplus(x: Tensor) -> Tensor:
    """Return log(1 + exp x), and x where that is it to all digits: ONNX Runtime has it in float32 alone."""
    return torch.where(x > 20.0, x, x.exp().log1p())


class _WrittenOut(TorchFunctionMode):
    """Write out by others, while a program is traced, what ONNX has no operators for."""

    functions: ClassVar[dict[object, Callable[..., object]]] = {
        torch.nn.functional.softplus: _softplus,
        torch.linalg.cross: _cross,
        torch.linalg.solve: _solve,
        torch.linalg.solve_triangular: _solve_triangular,
        torch.linalg.cholesky_ex: _cholesky_ex,
    }

    def __torch_function__(
        self,
        func: Callable[..., object],
        types: Sequence[type],
        args: tuple[object, ...] = (),
        kwargs: dict[str, object] | None = None,
    ) -> object:
        """Call in place of a function the one that stands for it."""
        return self.functions.get(func, func)(*args, **(kwargs or {}))


def called_by_onnx(files: Mapping[str, bytes]) -> Called:
    """Return what calls the entry points in ONNX Runtime, for arrays of states."""
    sessions = {name: onnx_session(content) for name, content in files.items()}

    def called(name: str, inputs: Values) -> Values:
        session = sessions[name]
        (output,) = session.run(None, {node.name: inputs[node.name] for node in session.get_inputs()})
        return {program_output(name): output}

    return called


def onnx_session(content: bytes) -> onnxruntime.InferenceSession:
    """Return a session on one core: the matrices are small."""
    options = onnxruntime.SessionOptions()
    # threads cost more than they take off such small matrices
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.log_severity_level = 3  # an input that a graph does not need is no matter
    return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
