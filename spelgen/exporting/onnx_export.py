"""--to onnx: the programs of torch.export as ONNX files, any batch size, float64."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import onnxruntime
import torch
from torch import Tensor

from spelgen.dynamics.prepared import PreparedModel
from spelgen.exporting.exported import UNITS, Exported, readme
from spelgen.exporting.parity import Called, Values, check_parity
from spelgen.exporting.torch_programs import PROGRAMS, export_program, program_inputs, program_output
from spelgen.exporting.trained import Trained
from spelgen.settings.tuning.exporting import TUNING


def export_onnx(trained: Trained) -> Exported:
    """Return an .onnx for each entry point. Raises RunError where ONNX Runtime and the model differ."""
    model = trained.model.prepared()
    files = {name: onnx_model(model, name) for name in PROGRAMS}
    parity = check_parity(called_by_onnx(files), trained, list(PROGRAMS), TUNING.onnx_tolerance)
    checked = f"Checked when exported, by ONNX Runtime {onnxruntime.__version__}: {parity.summary}."
    use = (
        "onnxruntime.InferenceSession('forward_dynamics.onnx').run(['qdd'], {'q': q, 'qd': qd, 'tau': tau}), "
        "float64 (batch, n), any batch."
    )
    size = model.n * model.elements
    memory = f"; z, friction's memory, is (batch, {size})" if size else ""
    about = f"{UNITS}{memory}; one file an entry point: {', '.join(PROGRAMS)}."
    text = readme(f"Dynamics of {trained.robot} in ONNX", use, trained.joint_names, about, checked)
    contents = {f"{name}.onnx": content for name, content in files.items()}
    return Exported("onnx", trained.robot, {**contents, "README.md": text}, (checked,))


def onnx_model(model: PreparedModel, name: str) -> bytes:
    """Return the serialised ONNX model of an entry point."""
    program = export_program(model, name, flat_memory=True)
    with _without_warnings():
        program = program.run_decompositions(_DECOMPOSITIONS)
        exported = torch.onnx.export(
            program,
            dynamo=True,
            input_names=program_inputs(model, name),
            output_names=[program_output(name)],
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
    n = matrix.shape[-1]
    identity = torch.eye(n, dtype=matrix.dtype)
    # a matrix of inputs has no batch
    rows = torch.cat([matrix.expand(*right.shape[:-1], n), right], dim=-1)
    for k in range(n):
        pivot = rows[..., k : k + 1, :]
        pivot = pivot / pivot[..., k : k + 1]
        rows = rows - (rows[..., k : k + 1] - identity[:, k : k + 1]) * pivot
    return rows[..., n:]


def _cholesky_ex(matrix: Tensor, *, upper: bool = False, check_errors: bool = False) -> tuple[Tensor, Tensor]:
    """Return L with L L^T the matrix, and 1 where it is not positive definite, else 0.

    Networks of M ask for the latter alone, and ONNX leaves L out.
    """
    rows, columns = matrix, []
    info = torch.zeros(matrix.shape[:-2], dtype=torch.int32)
    for k in range(matrix.shape[-1]):
        pivot = rows[..., k : k + 1, k : k + 1]
        # a pivot that is NaN counts as not positive
        info = torch.where(pivot[..., 0, 0] > 0, info, 1)
        columns.append(rows[..., k : k + 1] / pivot.sqrt())
        rows = rows - rows[..., k : k + 1] * rows[..., k : k + 1, :] / pivot
    return torch.cat(columns, dim=-1), info


# ONNX has no operators for these
_DECOMPOSITIONS = {
    torch.ops.aten.linalg_solve.default: _solve,
    torch.ops.aten.linalg_cholesky_ex.default: _cholesky_ex,
}


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
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3  # an input that a graph does not need is no matter
    return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
