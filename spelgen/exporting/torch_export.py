"""--to torch: programs of torch.export that need torch alone, and the trained weights as safetensors."""

from __future__ import annotations

import io
import warnings
from typing import Any

import torch
from safetensors.torch import save

from spelgen.exporting.exported import Exported
from spelgen.exporting.parity import Values, check_parity
from spelgen.exporting.readme import UNITS, readme
from spelgen.exporting.torch_programs import PROGRAMS, export_program
from spelgen.exporting.trained import Trained

TOLERANCE = 1e-12


def export_torch(trained: Trained) -> Exported:
    """A .pt2 for each entry point, and model.safetensors. Raises RunError where they differ from the model."""
    prepared = trained.model.prepared()
    files: dict[str, bytes] = {}
    loaded: dict[str, Any] = {}
    for name in PROGRAMS:
        buffer = io.BytesIO()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of tensors that share memory, which are constants here
            torch.export.save(export_program(prepared, name), buffer)
        files[f"{name}.pt2"] = buffer.getvalue()
        loaded[name] = torch.export.load(io.BytesIO(buffer.getvalue())).module()

    def called(name: str, inputs: Values) -> Values:
        _, given, output = PROGRAMS[name]
        with torch.no_grad():
            return {output: loaded[name](*(torch.from_numpy(inputs[key]) for key in given)).numpy()}

    parity = check_parity(called, trained, list(PROGRAMS), TOLERANCE)
    checked = f"Checked when exported, by torch {torch.__version__}: {parity.summary}."
    files["model.safetensors"] = save(
        {k: v.contiguous().cpu() for k, v in trained.model.state_dict().items()}
    )
    use = (
        "qdd = torch.export.load('forward_dynamics.pt2').module()(q, qd, tau), float64 (batch, n), any batch; "
        "model.safetensors holds the trained weights by the names of the emitted module."
    )
    about = f"{UNITS}; the programs take no gradients by the weights."
    name = trained.arm.arm.name
    files["README.md"] = readme(f"Dynamics of {name} in torch", use, trained.joint_names, about, checked)
    return Exported("torch", name, files, (checked,))
