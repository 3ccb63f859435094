"""--to torch: programs of torch.export, which need only torch, and the trained parameters as safetensors."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable

import torch
from safetensors.torch import save
from torch import Tensor, nn

from spelgen.dynamics.prepared import PreparedModel
from spelgen.exporting.describe import Trained
from spelgen.exporting.entry_points import ENTRY_POINTS, select_names
from spelgen.exporting.exported import Exported, with_readme
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
"""The entry points with a program, and the methods that compute them."""


def export_torch(trained: Trained) -> Exported:
    """Return a .pt2 file per entry point and model.safetensors. Raises RunError if a program differs from the model."""
    model = trained.model.prepared()
    programs, files = {}, {}
    for name in select_names(trained.entries, PROGRAMS):
        programs[name] = files[f"{name}.pt2"] = _saved(export_program(model, name))
    parity = check_parity(_called_by_torch(programs, model), trained, list(programs), TUNING.tolerance)
    checked = f"Checked when exported, by torch {torch.__version__}: {parity.summary}"
    # clones, since safetensors refuses shared memory
    parameters = {key: x.cpu().contiguous().clone() for key, x in trained.model.state_dict().items()}
    use = (
        "qdd = torch.export.load('forward_dynamics.pt2').module()(q, qd, tau), float64 (batch, n), any batch, then z, "
        "(batch, n, K), if there is a friction state; "
        "model.safetensors contains the trained parameters by the names of the emitted module."
    )
    about = "the programs have no gradients with respect to parameters."
    files["model.safetensors"] = save(parameters)
    return with_readme(trained, "torch", files, use=use, about=about, summary=[checked])


def _saved(program: torch.export.ExportedProgram) -> bytes:
    """Return the content of a .pt2 file."""
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about shared memory of tensors, which are constants
        torch.export.save(program, buffer)
    return buffer.getvalue()


def _called_by_torch(files: dict[str, bytes], model: PreparedModel) -> Called:
    """Return a function that calls the programs of files."""
    programs = {name: torch.export.load(io.BytesIO(content)).module() for name, content in files.items()}

    def called(name: str, inputs: Values) -> Values:
        tensors = {key: torch.from_numpy(value) for key, value in inputs.items()}
        if model.elements:
            tensors["z"] = tensors["z"].reshape(-1, model.n, model.elements)
        with torch.no_grad():
            output = programs[name](*(tensors[key] for key in program_inputs(model, name)))
        return {program_output(name): output.numpy()}

    return called


class _Program(nn.Module):
    """An entry point with the inputs of its program."""

    def __init__(self, model: PreparedModel, name: str) -> None:
        super().__init__()
        self._model, self._function = model, PROGRAMS[name]
        self._stateful = "z" in program_inputs(model, name)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Return the output, (batch, ...), for inputs (batch, n) and z (batch, n, K) or (batch, n K)."""
        if self._stateful:
            *states, z = inputs
            return self._function(self._model, *states, z.reshape(-1, self._model.n, self._model.elements))
        return self._function(self._model, *inputs)


def export_program(
    model: PreparedModel, name: str, *, flat_state: bool = False
) -> torch.export.ExportedProgram:
    """Return the program of an entry point, with inputs (batch, n).

    The friction state z is (batch, n, K), or (batch, n K) if ``flat_state``.
    """
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(program_inputs(model, name), (model.n,))
    if "z" in shapes:
        shapes["z"] = (model.n * model.elements,) if flat_state else (model.n, model.elements)
    # a batch of two: torch.export treats one as a constant
    inputs = tuple(torch.full((2, *shape), 0.1, dtype=torch.float64) for shape in shapes.values())
    batch = tuple({0: torch.export.Dim("batch")} for _ in inputs)
    return torch.export.export(_Program(model, name), inputs, dynamic_shapes=(batch,))


def program_inputs(model: PreparedModel, name: str) -> tuple[str, ...]:
    """Return the names of the inputs of an entry point, with z only if the model has a friction state."""
    inputs = ENTRY_POINTS[name].inputs
    return inputs if model.elements else tuple(key for key in inputs if key != "z")


def program_output(name: str) -> str:
    """Return the name of the single output of an entry point."""
    (output,) = ENTRY_POINTS[name].outputs
    return output
