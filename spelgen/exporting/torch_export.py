"""Export with ``--to torch``: programs of torch.export, which need only torch, and the parameters as safetensors."""

import io
import warnings
from collections.abc import Sequence

import torch
from safetensors.torch import save
from torch import Tensor, nn

from spelgen.dynamics.prepared import PreparedModel
from spelgen.dynamics.tip import tip_kinematics
from spelgen.exporting.describe import Trained
from spelgen.exporting.exported import Exported, with_readme
from spelgen.exporting.parity import ENTRY_POINTS, PROGRAMS, Called, Values, check_parity, select_names
from spelgen.exporting.tuning import TUNING

FRICTION_STATE = ("friction_step", "friction_memory")
"""The entry points of models with a friction state."""


def export_torch(trained: Trained) -> Exported:
    """Return a .pt2 program per function of the model, such as inverse_dynamics, and its file of parameters.

    The file model.safetensors has all parameters of the model. Raises RunError if results of the programs and of the
    model differ.
    """
    model = prepared(trained)
    programs = {name: _saved(export_program(model, name)) for name in program_names(trained)}
    called = _called_by_torch(programs, model)
    parity = check_parity(called, trained, list(programs), TUNING.tolerance)
    # Tensors are cloned, since safetensors refuses tensors that share memory.
    parameters = {key: x.cpu().contiguous().clone() for key, x in trained.model.state_dict().items()}
    use = (
        f"Programs of torch.export, {number_shapes(model)}. model.safetensors has the trained parameters by the "
        "module's names."
    )
    about = "the programs have no gradients with respect to parameters."
    files = {f"{name}.pt2": content for name, content in programs.items()}
    files["model.safetensors"] = save(parameters)
    run = 'torch.export.load(f"{name}.pt2").module()(*inputs.values())'
    example = example_lines(model, list(programs), ["import torch"], run, "torch.zeros({}, dtype=torch.{})")
    summary = [f"Checked when exported, by torch {torch.__version__}: {parity.summary}"]
    return with_readme(trained, "torch", files, use=use, about=about, summary=summary, example=example)


def prepared(trained: Trained) -> PreparedModel:
    """Return the model in the form that `torch.export` converts to torch and ONNX programs.

    It is a copy with precomputed parameters, the kinematics of the tip, and the number type of the programs.
    """
    dtype = torch.float32 if trained.float32 else torch.float64
    return PreparedModel(trained.model, tip_kinematics(trained.arm), dtype=dtype)


def program_names(trained: Trained) -> list[str]:
    """Return the names of the functions to export as programs, such as inverse_dynamics.

    Raises RunError for unknown names in ``trained.entries``.
    """
    available = [name for name in PROGRAMS if trained.model.elements or name not in FRICTION_STATE]
    return select_names(trained.entries, available)


def number_shapes(model: PreparedModel) -> str:
    """Return the part of a README's sentence that states type and shapes of the inputs of exported programs."""
    shapes = f"{_number_type(model)} (batch, n), any batch"
    return f"{shapes}; z, the friction state, is (batch, n, {model.elements})" if model.elements else shapes


def _number_type(model: PreparedModel) -> str:
    """Return the name of the type of the numbers of an exported model: ``float32`` or ``float64``."""
    return str(model.dtype).removeprefix("torch.")


def example_lines(
    model: PreparedModel, names: Sequence[str], imports: Sequence[str], run: str, zeros: str
) -> list[str]:
    """Return lines of Python for the README of an export, which call each exported program.

    As in a control loop, the program friction_memory, which returns the initial friction state z, is called first, and
    friction_step, which updates z, is called last.

    Args:
        model: model that was exported.
        names: names of the programs.
        imports: import statements.
        run: source of the expression that the README's function ``run(name, **inputs)`` returns; it calls the program
            ``name`` with the arguments ``inputs``.
        zeros: format string for an array of zeros, such as "np.zeros(({}), np.{})", for dimensions and number type.
    """
    number = _number_type(model)
    lines = [*imports, "", "", "def run(name, **inputs):", f"    return {run}", "", ""]
    states = zeros.format(f"5, {model.n}", number)
    lines.append(f"q = qd = qdd = tau = dq = {states}  # a batch of 5; dq: change of q since the last step")
    if model.elements and "friction_memory" not in names:
        lines.append(f"z = {zeros.format(f'5, {model.n}, {model.elements}', number)}")
    # In a control loop, z is initialised before all other calls and updated after them.
    for name in sorted(names, key=lambda name: (name == "friction_step") - (name == "friction_memory")):
        output = "z" if name in FRICTION_STATE else program_output(name)
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
    """Return a function for `check_parity`. It loads a saved program and evaluates it for arrays of states."""
    # The saved files are loaded, so that the parity check includes saving and loading.
    programs = {name: torch.export.load(io.BytesIO(content)).module() for name, content in files.items()}

    def called(name: str, inputs: Values) -> Values:
        tensors = [torch.from_numpy(inputs[key]).to(model.dtype) for key in program_inputs(model, name)]
        with torch.no_grad():
            output = programs[name](*tensors)
        return {program_output(name): output.numpy()}

    return called


class _Program(nn.Module):
    """A module whose forward method is the entry point ``name`` of a model; torch.export requires such a module."""

    def __init__(self, model: PreparedModel, name: str) -> None:
        super().__init__()
        function = ENTRY_POINTS[name].reference
        assert function is not None
        self._model, self._function = model, function

    def forward(self, *inputs: Tensor) -> Tensor:
        """Return the output, (batch, ...), of the entry point, a function of the model such as inverse_dynamics.

        inputs: arguments of this function, such as q and qd, (batch, n); the friction state z, (batch, n, K).
        """
        return self._function(self._model, *inputs)


def export_program(model: PreparedModel, name: str) -> torch.export.ExportedProgram:
    """Return the torch.export program of a function of the model, such as inverse_dynamics, for any batch size.

    The inputs are (batch, n). The friction state z of K bristles per joint is (batch, n, K).
    """
    # The example has a batch of two, since torch.export makes a batch size of one a constant. Inputs are 0.1,
    # since friction may not be differentiable at zero.
    states = {"z": (2, model.n, model.elements)}
    inputs = tuple(
        torch.full(states.get(key, (2, model.n)), 0.1, dtype=model.dtype)
        for key in program_inputs(model, name)
    )
    batch = tuple({0: torch.export.Dim("batch")} for _ in inputs)
    return torch.export.export(_Program(model, name), inputs, dynamic_shapes=(batch,))


def program_inputs(model: PreparedModel, name: str) -> tuple[str, ...]:
    """Return the names of the inputs of a function such as inverse_dynamics, without z if friction has no state."""
    inputs = ENTRY_POINTS[name].inputs
    return inputs if model.elements else tuple(key for key in inputs if key != "z")


def program_output(name: str) -> str:
    """Return the name of the only output of a function, for example "tau" for inverse_dynamics."""
    (output,) = ENTRY_POINTS[name].outputs
    return output
