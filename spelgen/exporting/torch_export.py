"""Export with ``--to torch``: programs of torch.export, which need only torch, and the parameters as safetensors."""

import io
import warnings
from collections.abc import Callable, Sequence

import numpy as np
import torch
from safetensors.torch import save
from torch import Tensor, nn

from spelgen.dynamics.prepared import PreparedModel
from spelgen.dynamics.tip import tip_kinematics
from spelgen.exporting.describe import Trained
from spelgen.exporting.description import ENTRY_POINTS, select_names
from spelgen.exporting.exported import Exported, with_readme
from spelgen.exporting.parity import Called, Parity, Values, check_parity
from spelgen.exporting.tuning import TUNING

PROGRAMS: dict[str, Callable[..., Tensor]] = {
    "inverse_dynamics": PreparedModel.inverse_dynamics,
    "forward_dynamics": PreparedModel.forward_dynamics,
    "mass_matrix": PreparedModel.mass_matrix,
    "bias": PreparedModel.bias,
    "gravity": PreparedModel.gravity,
    "friction": PreparedModel.friction_torque,
    "friction_step": PreparedModel.memory_after,
    "friction_memory": PreparedModel.memory,
    "tip_pose": PreparedModel.pose,
    "tip_jacobian": PreparedModel.jacobian,
}
"""The entry points that are exported as programs, and the methods that compute them."""
FRICTION_STATE = ("friction_step", "friction_memory")
"""The entry points of models with a friction state."""


def export_torch(trained: Trained) -> Exported:
    """Return a .pt2 file per function of the model, such as inverse_dynamics, and its parameters as model.safetensors.

    Raises RunError if results of the programs and of the model differ.
    """
    model = prepared(trained)
    programs, files = {}, {}
    for name in program_names(trained):
        programs[name] = files[f"{name}.pt2"] = _saved(export_program(model, name))
    parity = check_programs(_called_by_torch(programs, model), trained, list(programs), TUNING.tolerance)
    checked = f"Checked when exported, by torch {torch.__version__}: {parity.summary}"
    # Tensors are cloned, since safetensors refuses tensors that share memory.
    parameters = {key: x.cpu().contiguous().clone() for key, x in trained.model.state_dict().items()}
    shapes = f"{number_type(model)} (batch, n), any batch"
    if model.elements:
        shapes += f"; z, the friction state, is (batch, n, {model.elements})"
    use = f"Programs of torch.export, {shapes}. model.safetensors has the trained parameters by the module's names."
    about = "the programs have no gradients with respect to parameters."
    example = ["import torch", "", "", "def run(name, **inputs):"]
    example += ['    return torch.export.load(f"{name}.pt2").module()(*inputs.values())', "", ""]
    zeros = f"torch.zeros(5, {model.n}, dtype=torch.{number_type(model)})"
    example += calls(model, list(programs), zeros, f"torch.zeros(5, {model.n}, {model.elements}).to(q)")
    files["model.safetensors"] = save(parameters)
    return with_readme(trained, "torch", files, use=use, about=about, summary=[checked], example=example)


def prepared(trained: Trained) -> PreparedModel:
    """Return a copy of the model from which torch and ONNX programs are made.

    It has precomputed parameters, the kinematics of the tip, and the number type of the programs.
    """
    dtype = torch.float32 if trained.float32 else torch.float64
    return PreparedModel(trained.model, tip_kinematics(trained.arm), dtype=dtype)


def program_names(trained: Trained) -> list[str]:
    """Return the names of the functions to export as programs, such as inverse_dynamics.

    Raises RunError for unknown names.
    """
    available = [name for name in PROGRAMS if trained.memory or name not in FRICTION_STATE]
    return select_names(trained.entries, available)


def check_programs(called: Called, trained: Trained, names: Sequence[str], tolerance: float) -> Parity:
    """Compare exported programs with the torch model; return the differences. Raises RunError if one is too large.

    Args:
        called: function that evaluates an exported program.
        trained: the model and its arm.
        names: names of the programs.
        tolerance: largest allowed difference of float64 programs; for float32 it is `ExportTuning.float32_tolerance`.
    """
    if trained.float32:
        return check_parity(called, trained, names, TUNING.float32_tolerance, dtype=np.float32)
    return check_parity(called, trained, names, tolerance)


def number_type(model: PreparedModel) -> str:
    """Return the name of the type of the numbers of an exported model: ``float32`` or ``float64``."""
    return str(model.dtype).removeprefix("torch.")


def calls(model: PreparedModel, names: Sequence[str], zeros: str, no_state: str) -> list[str]:
    """Return lines of Python for the README of an export, which call each exported program.

    As in a control loop, the program friction_memory, which returns the initial friction state z, is called first, and
    friction_step, which updates z, is called last.

    Args:
        model: model that was exported.
        names: names of the programs.
        zeros: Python expression for an array of zeros, (5, n): the example has a batch of five states.
        no_state: Python expression for the initial z, used if the program friction_memory is not exported.
    """
    lines = [f"q = qd = qdd = tau = dq = {zeros}  # a batch of 5; dq: change of q since the last step"]
    if model.elements and "friction_memory" not in names:
        lines.append(f"z = {no_state}")
    # In a control loop, z is initialised before all other calls and updated after them.
    for name in sorted(names, key=lambda name: (name == "friction_step") - (name == "friction_memory")):
        output = {"friction_memory": "z", "friction_step": "z"}.get(name, program_output(name))
        inputs = ", ".join(f"{key}={key}" for key in program_inputs(model, name))
        lines.append(f'{output} = run("{name}", {inputs})  # {ENTRY_POINTS[name].about}')
    return lines


def _saved(program: torch.export.ExportedProgram) -> bytes:
    """Return the content of the .pt2 file of an exported program."""
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch warns of constants that share memory, which is harmless
        torch.export.save(program, buffer)
    return buffer.getvalue()


def _called_by_torch(files: dict[str, bytes], model: PreparedModel) -> Called:
    """Return a function for `check_parity`, which loads and evaluates the saved programs for arrays of states."""
    # The saved files are loaded, so that the parity check includes saving and loading.
    programs = {name: torch.export.load(io.BytesIO(content)).module() for name, content in files.items()}

    def called(name: str, inputs: Values) -> Values:
        tensors = {key: torch.from_numpy(value).to(model.dtype) for key, value in inputs.items()}
        if model.elements:
            tensors["z"] = tensors["z"].reshape(-1, model.n, model.elements)
        with torch.no_grad():
            output = programs[name](*(tensors[key] for key in program_inputs(model, name)))
        return {program_output(name): output.numpy()}

    return called


class _Program(nn.Module):
    """A module whose forward method is one entry point of a model; torch.export requires such a module.

    model: the model with precomputed parameters. name: name of the entry point. flat_state: True if the friction state
    z is (batch, n K) instead of (batch, n, K) for K bristles per joint.
    """

    def __init__(self, model: PreparedModel, name: str, flat_state: bool) -> None:
        super().__init__()
        self._model, self._function, self._name, self._flat = model, PROGRAMS[name], name, flat_state
        self._names = program_inputs(model, name)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Return the entry point's output, (batch, ...).

        inputs: (batch, n) each, except z: (batch, n, K) or (batch, n K) for K bristles per joint.
        """
        states = dict(zip(self._names, inputs, strict=True))
        if "z" in states:
            states["z"] = states["z"].reshape(-1, self._model.n, self._model.elements)
        output = self._function(self._model, *states.values())
        return output.flatten(1) if self._flat and self._name in FRICTION_STATE else output


def export_program(
    model: PreparedModel, name: str, *, flat_state: bool = False
) -> torch.export.ExportedProgram:
    """Return the torch.export program of a function of the model, such as inverse_dynamics, for any batch size.

    The inputs are (batch, n). The friction state z of K bristles per joint is (batch, n, K), or (batch, n K) if
    ``flat_state``.
    """
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(program_inputs(model, name), (model.n,))
    if "z" in shapes:
        shapes["z"] = (model.n * model.elements,) if flat_state else (model.n, model.elements)
    # The example has a batch of two, since torch.export makes a batch size of one a constant. Inputs are 0.1,
    # since friction may not be differentiable at zero.
    inputs = tuple(torch.full((2, *shape), 0.1, dtype=model.dtype) for shape in shapes.values())
    batch = tuple({0: torch.export.Dim("batch")} for _ in inputs)
    return torch.export.export(_Program(model, name, flat_state), inputs, dynamic_shapes=(batch,))


def program_inputs(model: PreparedModel, name: str) -> tuple[str, ...]:
    """Return the names of the inputs of a function such as inverse_dynamics, without z if friction has no state."""
    inputs = ENTRY_POINTS[name].inputs
    return inputs if model.elements else tuple(key for key in inputs if key != "z")


def program_output(name: str) -> str:
    """Return the name of the only output of a function, for example "tau" for inverse_dynamics."""
    (output,) = ENTRY_POINTS[name].outputs
    return output
