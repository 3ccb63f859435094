"""--to torch: programs of torch.export that need torch alone, and the trained weights as safetensors."""

from __future__ import annotations

import io
import warnings

import torch
from safetensors.torch import save

from spelgen.dynamics.prepared import PreparedModel
from spelgen.exporting.entry_points import chosen
from spelgen.exporting.exported import Exported, folder_export
from spelgen.exporting.parity import Called, Values, check_parity
from spelgen.exporting.torch_programs import PROGRAMS, export_program, program_inputs, program_output
from spelgen.exporting.trained import Trained
from spelgen.settings.tuning.exporting import TUNING


def export_torch(trained: Trained) -> Exported:
    """Return a .pt2 for each entry point, and model.safetensors. Raises RunError where they differ from the model."""
    model = trained.model.prepared()
    programs = {name: _saved(export_program(model, name)) for name in chosen(trained.entries, PROGRAMS)}
    parity = check_parity(_called_by_torch(programs, model), trained, list(programs), TUNING.tolerance)
    checked = f"Checked when exported, by torch {torch.__version__}: {parity.summary}."
    # clones: some tables of an emitted module stand in two places
    weights = {key: x.cpu().contiguous().clone() for key, x in trained.model.state_dict().items()}
    use = (
        "qdd = torch.export.load('forward_dynamics.pt2').module()(q, qd, tau), float64 (batch, n), any batch, then z, "
        "(batch, n, K), where friction has a memory; "
        "model.safetensors contains the trained weights by the names of the emitted module."
    )
    about = "the programs take no gradients by the weights."
    files = {f"{name}.pt2": content for name, content in programs.items()}
    files["model.safetensors"] = save(weights)
    return folder_export(trained, "torch", "in torch", files, use=use, about=about, checked=checked)


def _saved(program: torch.export.ExportedProgram) -> bytes:
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of tensors that share memory, which are constants here
        torch.export.save(program, buffer)
    return buffer.getvalue()


def _called_by_torch(files: dict[str, bytes], model: PreparedModel) -> Called:
    programs = {name: torch.export.load(io.BytesIO(content)).module() for name, content in files.items()}

    def called(name: str, inputs: Values) -> Values:
        tensors = {key: torch.from_numpy(value) for key, value in inputs.items()}
        if model.elements:
            tensors["z"] = tensors["z"].reshape(-1, model.n, model.elements)
        # the weights are constants
        with torch.no_grad():
            output = programs[name](*(tensors[key] for key in program_inputs(model, name)))
        return {program_output(name): output.numpy()}

    return called
