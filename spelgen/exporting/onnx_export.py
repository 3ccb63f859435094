"""--to onnx: a file for each entry point, any batch size, float64."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import onnxruntime

from spelgen.exporting.exported import Exported
from spelgen.exporting.onnx_model import ENTRIES, onnx_model
from spelgen.exporting.parity import Called, Values, check_parity
from spelgen.exporting.readme import UNITS, readme
from spelgen.exporting.trained import Trained

TOLERANCE = 1e-10


def export_onnx(trained: Trained) -> Exported:
    """An .onnx for each entry point. Raises RunError where ONNX Runtime gives something else than the model."""
    model = trained.described
    files = {name: onnx_model(model, name) for name in ENTRIES}
    parity = check_parity(called_by_onnx(files), trained, list(ENTRIES), TOLERANCE, memory=model.memory)
    checked = f"Checked when exported, by ONNX Runtime {onnxruntime.__version__}: {parity.summary}."
    use = (
        "onnxruntime.InferenceSession('forward_dynamics.onnx').run(['qdd'], {'q': q, 'qd': qd, 'tau': tau}), "
        "float64 (batch, n), any batch."
    )
    memory = f"; z, friction's memory, is (batch, {model.memory})" if model.memory else ""
    about = f"{UNITS}{memory}; one file an entry point: {', '.join(ENTRIES)}."
    text = readme(f"Dynamics of {model.robot} in ONNX", use, trained.joint_names, about, checked)
    contents = {f"{name}.onnx": content for name, content in files.items()}
    return Exported("onnx", model.robot, {**contents, "README.md": text}, (checked,))


def called_by_onnx(files: Mapping[str, bytes]) -> Called:
    """The entry points in ONNX Runtime, for arrays of states."""
    sessions = {name: onnx_session(content) for name, content in files.items()}

    def called(name: str, inputs: Values) -> Values:
        session = sessions[name]
        (found,) = session.run(None, {each.name: inputs[each.name] for each in session.get_inputs()})
        return {ENTRIES[name][1]: found}

    return called


def onnx_session(content: bytes) -> Any:
    """A session on one core: the matrices are small."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3  # an input that a graph does not need is no matter
    return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
