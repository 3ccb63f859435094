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
from spelgen.exporting.torch_programs import PROGRAMS, export_program, program_inputs
from spelgen.exporting.trained import Trained

TOLERANCE = 1e-12


def export_torch(trained: Trained) -> Exported:
    """A .pt2 for each entry point, and model.safetensors. Raises RunError where they differ from the model."""
    prepared = trained.model.prepared()
    memory = prepared.n * prepared.elements
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
        tensors = {key: torch.from_numpy(value) for key, value in inputs.items()}
        if memory:
            tensors["z"] = tensors["z"].unflatten(-1, (prepared.n, -1))
        given = [tensors[key] for key in program_inputs(prepared, name)]
        with torch.no_grad():
            return {PROGRAMS[name][2]: loaded[name](*given).numpy()}

    parity = check_parity(called, trained, list(PROGRAMS), TOLERANCE, memory=memory)
    checked = f"Checked when exported, by torch {torch.__version__}: {parity.summary}."
    # clones: some tables of an emitted module stand in two places
    files["model.safetensors"] = save(
        {k: v.cpu().contiguous().clone() for k, v in trained.model.state_dict().items()}
    )
    use = (
        "qdd = torch.export.load('forward_dynamics.pt2').module()(q, qd, tau), float64 (batch, n), any batch, then z, "
        "(batch, n, K), where friction has a memory; "
        "model.safetensors holds the trained weights by the names of the emitted module."
    )
    about = f"{UNITS}; the programs take no gradients by the weights."
    name = trained.arm.arm.name
    files["README.md"] = readme(f"Dynamics of {name} in torch", use, trained.joint_names, about, checked)
    return Exported("torch", name, files, (checked,))
