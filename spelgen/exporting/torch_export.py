"""--to torch: programs of torch.export that need torch alone, for any batch, and the trained weights as safetensors."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable

import torch
from safetensors.torch import save
from torch import Tensor, nn

from spelgen.dynamics.prepared import PreparedModel
from spelgen.exporting.describe import Trained
from spelgen.exporting.entry_points import ENTRY_POINTS, chosen
from spelgen.exporting.exported import Exported, folder_export
from spelgen.exporting.parity import Called, Values, check_parity
from spelgen.exporting.tuning import TUNING

PROGRAMS: dict[str, Callable[..., Tensor]] = {
    "inverse_dynamics": PreparedModel.inverse_dynamics,
    "forward_dynamics": PreparedModel.forward_dynamics,
    "mass_matrix": PreparedModel.mass_matrix,
    "bias": PreparedModel.bias,
    "gravity": PreparedModel.gravity,
    "friction": PreparedModel.friction_torque,
}
"""The entry points that have a program, and the methods that compute them."""


def export_torch(trained: Trained) -> Exported:
    """Return a .pt2 for each entry point, and model.safetensors. Raises RunError where they differ from the model."""
    model = trained.model.prepared()
    programs, files = {}, {}
    for name in chosen(trained.entries, PROGRAMS):
        programs[name] = files[f"{name}.pt2"] = _saved(export_program(model, name))
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


class _Program(nn.Module):
    def __init__(self, model: PreparedModel, name: str) -> None:
        super().__init__()
        self._model, self._function = model, PROGRAMS[name]
        self._has_memory = "z" in program_inputs(model, name)

    def forward(self, *inputs: Tensor) -> Tensor:
        if self._has_memory:
            *states, z = inputs
            return self._function(self._model, *states, z.reshape(-1, self._model.n, self._model.elements))
        return self._function(self._model, *inputs)


def export_program(
    model: PreparedModel, name: str, *, flat_memory: bool = False
) -> torch.export.ExportedProgram:
    """Return the program of an entry point; the first dimension of its inputs is the batch.

    z, the memory of friction, is (batch, n, K), or (batch, n K) where ``flat_memory``; the other inputs are (batch, n).
    """
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(program_inputs(model, name), (model.n,))
    if "z" in shapes:
        shapes["z"] = (model.n * model.elements,) if flat_memory else (model.n, model.elements)
    # a batch of two: torch.export would take one for a constant
    inputs = tuple(torch.full((2, *shape), 0.1, dtype=torch.float64) for shape in shapes.values())
    batch = tuple({0: torch.export.Dim("batch")} for _ in inputs)
    return torch.export.export(_Program(model, name), inputs, dynamic_shapes=(batch,))


def program_inputs(model: PreparedModel, name: str) -> tuple[str, ...]:
    """Return the names of an entry point's inputs; z is among them where friction has a memory."""
    inputs = ENTRY_POINTS[name].inputs
    return inputs if model.elements else tuple(key for key in inputs if key != "z")


def program_output(name: str) -> str:
    """Return the name of an entry point's only output."""
    (output,) = ENTRY_POINTS[name].outputs
    return output
