"""--to onnx: a file for each entry point, any batch size, float64."""

from __future__ import annotations

import contextlib
import io
import logging
import warnings
from collections.abc import Iterator
from typing import Any

import onnxruntime
import torch

from spelgen.exporting.exported import Exported
from spelgen.exporting.parity import Values, check_parity
from spelgen.exporting.readme import UNITS, readme
from spelgen.exporting.torch_programs import PROGRAMS, export_program, without_linear_algebra
from spelgen.exporting.trained import Trained

TOLERANCE = 1e-10


def export_onnx(trained: Trained) -> Exported:
    """An .onnx for each entry point. Raises RunError where ONNX Runtime gives something else than the model."""
    files = onnx_files(trained, list(PROGRAMS))
    sessions = {name: onnx_session(content) for name, content in files.items()}

    def called(name: str, inputs: Values) -> Values:
        _, given, output = PROGRAMS[name]
        (found,) = sessions[f"{name}.onnx"].run([output], {key: inputs[key] for key in given})
        return {output: found}

    parity = check_parity(called, trained, list(PROGRAMS), TOLERANCE)
    checked = f"Checked when exported, by ONNX Runtime {onnxruntime.__version__}: {parity.summary}."
    use = (
        "onnxruntime.InferenceSession('forward_dynamics.onnx').run(['qdd'], {'q': q, 'qd': qd, 'tau': tau}), "
        "float64 (batch, n), any batch."
    )
    about = f"{UNITS}; one file an entry point: {', '.join(PROGRAMS)}."
    name = trained.arm.arm.name
    text = readme(f"Dynamics of {name} in ONNX", use, trained.joint_names, about, checked)
    return Exported("onnx", name, {**files, "README.md": text}, (checked,))


def onnx_files(trained: Trained, names: list[str]) -> dict[str, bytes]:
    """The ONNX of these entry points, by file name."""
    prepared, files = trained.model.prepared(), {}
    for name in names:
        _, inputs, output = PROGRAMS[name]
        program = without_linear_algebra(export_program(prepared, name))
        with _quiet():
            made: Any = torch.onnx.export(
                program, dynamo=True, input_names=list(inputs), output_names=[output], verbose=False
            )
        buffer = io.BytesIO()
        made.save(buffer)
        files[f"{name}.onnx"] = buffer.getvalue()
    return files


def onnx_session(content: bytes) -> Any:
    """A session on one core: the matrices are small."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without the exporter's remarks on packages that are not needed."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
