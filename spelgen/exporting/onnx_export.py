"""Export with ``--to onnx``: programs of torch.export as ONNX files in float64 or float32, for any batch size."""

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
from spelgen.exporting import torch_export
from spelgen.exporting.describe import Trained
from spelgen.exporting.exported import Exported, with_readme
from spelgen.exporting.parity import Called, Values, check_parity
from spelgen.exporting.tuning import TUNING


def export_onnx(trained: Trained) -> Exported:
    """Return an .onnx file for each entry point, a function of the model such as inverse_dynamics, with a README.

    Raises RunError if results of ONNX Runtime and of the model differ.
    """
    model = torch_export.prepared(trained)
    models = {name: onnx_model(model, name) for name in torch_export.program_names(trained)}
    parity = check_parity(called_by_onnx(models), trained, list(models), TUNING.onnx_tolerance)
    use = f"ONNX files for any runtime, {torch_export.number_shapes(model)}."
    about = f"one file per entry point: {', '.join(models)}."
    files = {f"{name}.onnx": content for name, content in models.items()}
    imports = ["import numpy as np", "import onnxruntime"]
    run = 'onnxruntime.InferenceSession(f"{name}.onnx").run(None, inputs)[0]'
    example = torch_export.example_lines(model, list(models), imports, run, "np.zeros(({}), np.{})")
    summary = [f"Checked when exported, by ONNX Runtime {onnxruntime.__version__}: {parity.summary}"]
    return with_readme(trained, "onnx", files, use=use, about=about, summary=summary, example=example)


def onnx_model(model: PreparedModel, name: str) -> bytes:
    """Return the serialised ONNX model of an entry point, a function of the model such as inverse_dynamics."""
    # Functions without an ONNX operator are replaced already while torch traces the program.
    with _silent_exporter():
        with _Decomposed():
            program = torch_export.export_program(model, name)
        exported = torch.onnx.export(
            program,
            dynamo=True,
            input_names=torch_export.program_inputs(model, name),
            output_names=[torch_export.program_output(name)],
            custom_translation_table={torch.ops.aten.scalar_tensor.default: _scalar_tensor},
            verbose=False,
        )
    assert exported is not None
    content = exported.model_proto
    # torch's metadata of the nodes are removed: they would be two thirds of the file.
    for described in (content, content.graph, *content.graph.node):
        described.ClearField("metadata_props")
    return bytes(content.SerializeToString())


@contextmanager
def _silent_exporter() -> Iterator[None]:
    """Suppress warnings of torch's ONNX exporter about absent torchvision and deprecated functions."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    finally:
        logger.setLevel(level)


def _cross(a: Tensor, b: Tensor, *, dim: int) -> Tensor:
    """Return the cross product of a and b, (...,) of equal shapes, along the dimension `dim` of size 3.

    It replaces torch.linalg.cross, which has no ONNX operator.
    """
    second, third = torch.tensor([1, 2, 0]), torch.tensor([2, 0, 1])
    forward = a.index_select(dim, second) * b.index_select(dim, third)
    return forward - a.index_select(dim, third) * b.index_select(dim, second)


def _solve(matrix: Tensor, right: Tensor) -> Tensor:
    """Return matrix^-1 right, (..., n, columns), by Gauss-Jordan elimination without pivoting.

    It replaces torch.linalg.solve, which has no ONNX operator. matrix: (..., n, n), positive definite, or triangular
    with a unit diagonal. right: (..., n, columns).
    """
    n = matrix.shape[-1]  # `n` is a Python integer, so that tracing unrolls the loop over k
    identity = torch.eye(n, dtype=matrix.dtype)
    # Either `matrix` or `right` may have no batch dimension: both are expanded to the batch of the other one.
    batch = torch.broadcast_shapes(matrix.shape[:-2], right.shape[:-2])
    # The elimination transforms matrix and right-hand side together, as columns of one array.
    rows = torch.cat([matrix.expand(*batch, n, n), right.expand(*batch, *right.shape[-2:])], dim=-1)
    for k in range(n):
        pivot = rows[..., k : k + 1, :]
        pivot = pivot / pivot[..., k : k + 1]
        rows = rows - (rows[..., k : k + 1] - identity[:, k : k + 1]) * pivot
    return rows[..., n:]


def _solve_triangular(matrix: Tensor, right: Tensor, *, upper: bool, unitriangular: bool) -> Tensor:
    """Return matrix^-1 right, (..., n, columns), for a triangular matrix (..., n, n) with a unit diagonal.

    It replaces torch.linalg.solve_triangular, which has no ONNX operator. upper: True for an upper triangular matrix.
    The values on the diagonal are not used: all calls of the runtime have ``unitriangular=True``.
    """
    identity = torch.eye(matrix.shape[-1], dtype=matrix.dtype)
    return _solve(matrix - matrix * identity + identity, right)


class _Cholesky(NamedTuple):
    L: Tensor
    info: Tensor


def _cholesky_ex(matrix: Tensor) -> _Cholesky:
    """Return the matrix (..., n, n) and info (...): 0 if the matrix is positive definite, otherwise 1.

    It replaces torch.linalg.cholesky_ex, which has no ONNX operator. The matrix is returned in place of its Cholesky
    factor, since models use only info.
    """
    rows = matrix
    info = torch.zeros(matrix.shape[:-2], dtype=torch.int32)
    for k in range(matrix.shape[-1]):
        pivot = rows[..., k : k + 1, k : k + 1]
        # A comparison with NaN is false, so info is 1 for a matrix with NaN, too.
        info = torch.where(pivot[..., 0, 0] > 0, info, 1)
        rows = rows - rows[..., k : k + 1] * rows[..., k : k + 1, :] / pivot
    return _Cholesky(matrix, info)


def _scalar_tensor(s: float, dtype: int = onnx.TensorProto.DOUBLE, **options: object) -> onnxscript.ir.Value:
    """Return the ONNX constant of the number s in the ONNX type ``dtype``, by default double precision.

    It replaces torch's own translation, which would round the number to float32.
    """
    value = np.array(s, dtype=onnx.helper.tensor_dtype_to_np_dtype(dtype))
    constant = onnxscript.opset18.Constant(value=onnx.numpy_helper.from_array(value))
    return cast("onnxscript.ir.Value", constant)


def _softplus(x: Tensor) -> Tensor:
    """Return softplus(x) = log(1 + exp x), (...); the softplus of ONNX Runtime supports only float32."""
    return torch.where(x > 20.0, x, x.exp().log1p())


class _Decomposed(TorchFunctionMode):
    """Context in which torch functions without ONNX operators, such as solve, are replaced by decompositions."""

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
        """Call the torch function ``func``, or its replacement if the class attribute ``functions`` has one."""
        return self.functions.get(func, func)(*args, **(kwargs or {}))


def called_by_onnx(files: Mapping[str, bytes]) -> Called:
    """Return a function for `check_parity` that evaluates an entry point (key of ``files``) in ONNX Runtime."""
    sessions = {name: onnx_session(content) for name, content in files.items()}

    def called(name: str, inputs: Values) -> Values:
        session = sessions[name]
        types = {"tensor(float)": np.float32, "tensor(double)": np.float64}
        arrays = {node.name: inputs[node.name].astype(types[node.type]) for node in session.get_inputs()}
        (output,) = session.run(None, arrays)
        return {torch_export.program_output(name): output}

    return called


def onnx_session(content: bytes) -> onnxruntime.InferenceSession:
    """Return a session of ONNX Runtime, with one thread, for the content of an .onnx file."""
    options = onnxruntime.SessionOptions()
    # One thread is used, since synchronising several takes longer than operations with small matrices.
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.log_severity_level = 3  # with level 3, only errors are printed, no warnings of unused inputs
    return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
