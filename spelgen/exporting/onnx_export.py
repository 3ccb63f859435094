"""--to onnx: the programs of torch.export as ONNX files, any batch size, float64."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import NamedTuple, cast

import numpy as np
import onnx
import onnxruntime
import onnxscript
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from spelgen.dynamics.prepared import PreparedModel
from spelgen.exporting.entry_points import chosen
from spelgen.exporting.exported import Exported, folder_export
from spelgen.exporting.parity import Called, Values, check_parity
from spelgen.exporting.torch_programs import PROGRAMS, export_program, program_inputs, program_output
from spelgen.exporting.trained import Trained
from spelgen.settings.tuning.exporting import TUNING


def export_onnx(trained: Trained) -> Exported:
    """Return an .onnx for each entry point. Raises RunError where ONNX Runtime and the model differ."""
    model = trained.model.prepared()
    files = {name: onnx_model(model, name) for name in chosen(trained.entries, PROGRAMS)}
    parity = check_parity(called_by_onnx(files), trained, list(files), TUNING.onnx_tolerance)
    checked = f"Checked when exported, by ONNX Runtime {onnxruntime.__version__}: {parity.summary}."
    use = (
        "onnxruntime.InferenceSession('forward_dynamics.onnx').run(['qdd'], {'q': q, 'qd': qd, 'tau': tau}), "
        "float64 (batch, n), any batch."
    )
    size = model.n * model.elements
    about = f"one file an entry point: {', '.join(files)}."
    if size:
        about = f"z, friction's memory, is (batch, {size}); {about}"
    contents = {f"{name}.onnx": content for name, content in files.items()}
    return folder_export(trained, "onnx", "in ONNX", contents, use=use, about=about, checked=checked)


def onnx_model(model: PreparedModel, name: str) -> bytes:
    """Return the serialised ONNX model of an entry point."""
    with _without_warnings(), _WrittenOut():
        program = export_program(model, name, flat_memory=True)
    with _without_warnings():
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
    content.ClearField("metadata_props")
    content.graph.ClearField("metadata_props")
    for node in content.graph.node:
        # torch's own names for each node: two thirds of the file
        node.ClearField("metadata_props")
    serialised: bytes = content.SerializeToString()
    return serialised


def _solve(matrix: Tensor, right: Tensor, *, left: bool = True) -> Tensor:
    """Return matrix^-1 right by Gauss and Jordan; M is positive definite and needs no pivoting."""
    n = matrix.shape[-1]  # a constant of the program, so that the loop is written out
    identity = torch.eye(n, dtype=matrix.dtype)
    # a matrix of inputs has no batch, nor has a right side that is the identity
    batch = torch.broadcast_shapes(matrix.shape[:-2], right.shape[:-2])
    matrix = matrix.expand(*batch, n, n)
    right = right.expand(*batch, *right.shape[-2:])
    rows = torch.cat([matrix, right], dim=-1)
    for k in range(n):
        pivot = rows[..., k : k + 1, :]
        pivot = pivot / pivot[..., k : k + 1]
        rows = rows - (rows[..., k : k + 1] - identity[:, k : k + 1]) * pivot
    return rows[..., n:]


def _solve_triangular(
    matrix: Tensor, right: Tensor, *, upper: bool, left: bool = True, unitriangular: bool = False
) -> Tensor:
    """Return matrix^-1 right, of one triangle of the matrix."""
    if unitriangular:
        matrix = torch.eye(matrix.shape[-1], dtype=matrix.dtype) + (
            matrix.triu(1) if upper else matrix.tril(-1)
        )
    else:
        matrix = matrix.triu() if upper else matrix.tril()
    return _solve(matrix, right)


def _softplus(x: Tensor, beta: float = 1.0, threshold: float = 20.0) -> Tensor:
    """Return log(1 + exp(x)), which ONNX Runtime has in float32 alone."""
    smooth = torch.relu(x) + torch.log(1 + torch.exp(-x.abs()))
    return torch.where(x > threshold, x, smooth)


class _Definiteness(NamedTuple):
    """Hold 1 where a matrix is not positive definite, else 0: of a Cholesky factor networks of M use this alone."""

    info: Tensor


def _cholesky_ex(matrix: Tensor) -> _Definiteness:
    """Return what the pivots of a Cholesky factor say, without the factor."""
    rows = matrix
    info = torch.zeros(matrix.shape[:-2], dtype=torch.int32)
    for k in range(matrix.shape[-1]):
        pivot = rows[..., k : k + 1, k : k + 1]
        # a pivot that is NaN counts as not positive
        info = torch.where(pivot[..., 0, 0] > 0, info, 1)
        rows = rows - rows[..., k : k + 1] * rows[..., k : k + 1, :] / pivot
    return _Definiteness(info)


def _scalar_tensor(
    s: float,
    dtype: int = onnx.TensorProto.DOUBLE,
    layout: str = "",
    device: str = "",
    pin_memory: bool = False,
) -> onnxscript.ir.Value:
    """Return a constant: torch's own translation rounds it to float32 first, an error of 1e-8 in networks."""
    value = np.array(s, dtype=onnx.helper.tensor_dtype_to_np_dtype(dtype))
    constant = onnxscript.opset18.Constant(value=onnx.numpy_helper.from_array(value))
    return cast("onnxscript.ir.Value", constant)


_WRITTEN_OUT: dict[object, Callable[..., object]] = {
    torch.linalg.solve: _solve,
    torch.linalg.solve_triangular: _solve_triangular,
    torch.nn.functional.softplus: _softplus,
    torch.linalg.cholesky_ex: _cholesky_ex,
}


class _WrittenOut(TorchFunctionMode):
    """Write out, while a program is traced, the functions that ONNX has no operators for."""

    def __torch_function__(
        self,
        func: Callable[..., object],
        types: object,
        args: tuple[object, ...] = (),
        kwargs: dict[str, object] | None = None,
    ) -> object:
        """Call a function, or what stands for it."""
        return _WRITTEN_OUT.get(func, func)(*args, **(kwargs or {}))


@contextmanager
def _without_warnings() -> Iterator[None]:
    """Silence what torch's exporter says of itself: that torchvision is absent, that it uses what is deprecated."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


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
