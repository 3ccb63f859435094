"""--to casadi: each entry point as a file of a CasADi function, with derivatives by CasADi's own."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

import casadi as ca
import numpy as np

from spelgen.exporting.casadi_residuals import residual_values
from spelgen.exporting.description import TrainedModel
from spelgen.exporting.entry_points import (
    EntryPoint,
    entry_points,
    expression_function,
    residuals_needed,
)
from spelgen.exporting.exported import Exported
from spelgen.exporting.parity import Called, Values, check_parity
from spelgen.exporting.readme import UNITS, readme
from spelgen.exporting.trained import Trained

TOLERANCE = 1e-12


def export_casadi(trained: Trained) -> Exported:
    """A file for each entry point. Raises RunError where they do not give what the model gives."""
    model = trained.described
    functions = casadi_functions(model)
    names = list(functions)
    parity = check_parity(called_by_state(functions), trained, names, TOLERANCE, memory=model.memory)
    checked = f"Checked when exported, by CasADi {ca.CasadiMeta.version()}: {parity.summary}."
    use = (
        "qdd = casadi.Function.load('forward_dynamics.casadi')(q, qd, tau, z) takes numbers or symbols: "
        "its derivatives, of any order, are CasADi's; *_derivatives.casadi hold the first ones ready."
    )
    about = f"{UNITS}; z is friction's memory, {model.memory} numbers: casadi.DM(0, 1) where there are none."
    files = {f"{name}.casadi": _saved(function) for name, function in functions.items()}
    text = readme(f"Dynamics of {model.robot} in CasADi", use, trained.joint_names, about, checked)
    return Exported("casadi", model.robot, {**files, "README.md": text}, (checked,))


def casadi_functions(model: TrainedModel) -> dict[str, ca.Function]:
    """Every entry point: of scalar expressions, and of matrices what stands beside rigid bodies."""
    found: dict[str, ca.Function] = {}
    for entry in entry_points(model):
        if entry.level == "jets" and model.residuals:
            found[entry.name] = _derivatives(entry, found[entry.name.removesuffix("_derivatives")])
        else:
            found[entry.name] = _with_residuals(entry, model)
    return found


def _with_residuals(entry: EntryPoint, model: TrainedModel) -> ca.Function:
    expressions = expression_function(entry, model)
    needed = residuals_needed(expressions)
    if not needed:
        return expressions
    given = [ca.MX.sym(name, expressions.size1_in(name)) for name in entry.inputs]
    states = dict(zip(entry.inputs, given, strict=True))
    residuals = residual_values(model, states["q"], states.get("qd"))
    arguments = [*given, *(residuals[name] for name in needed)]
    names = [name for name, _ in entry.outputs]
    return ca.Function(entry.name, given, expressions.call(arguments), list(entry.inputs), names)


def _derivatives(entry: EntryPoint, function: ca.Function) -> ca.Function:
    given = function.mx_in()
    (output,) = function.call(given)
    places = [name for name in entry.inputs if name in ("q", "qd", "tau")]
    by_input = [ca.densify(ca.jacobian(output, given[entry.inputs.index(name)])) for name in places]
    names = [name for name, _ in entry.outputs]
    return ca.Function(entry.name, given, by_input, list(entry.inputs), names)


def _saved(function: ca.Function) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "function.casadi")
        function.save(str(path))
        return path.read_bytes()


def called_by_state(functions: Mapping[str, ca.Function]) -> Called:
    """CasADi's functions, for arrays of states."""

    def called(name: str, inputs: Values) -> Values:
        function = functions[name]
        rows = [inputs[key] for key in function.name_in()]
        found = [function.call([ca.DM(x) for x in state]) for state in zip(*rows, strict=True)]
        outputs = function.name_out()
        return {key: np.array([_array(each[k]) for each in found]) for k, key in enumerate(outputs)}

    return called


def _array(value: ca.DM) -> np.ndarray:
    full: np.ndarray = value.full()
    return full[:, 0] if full.shape[1] == 1 else full
