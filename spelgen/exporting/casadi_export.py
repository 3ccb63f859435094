"""--to casadi: a file with a CasADi function for each entry point."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

import casadi as ca
import numpy as np

from spelgen.exporting.describe import Trained
from spelgen.exporting.description import TrainedModel
from spelgen.exporting.entry_points import ENTRY_POINTS, EntryPoint
from spelgen.exporting.exported import Exported, with_readme
from spelgen.exporting.model_expressions import expression_functions, residuals_needed
from spelgen.exporting.parity import Called, Values, check_parity
from spelgen.exporting.residual_expressions import residual_values
from spelgen.exporting.tuning import TUNING


def export_casadi(trained: Trained) -> Exported:
    """Return a file for each entry point. Raises RunError if a function differs from the model."""
    model = trained.described
    functions = casadi_functions(model, trained.entry_points)
    parity = check_parity(called_by_state(functions), trained, list(functions), TUNING.tolerance)
    checked = f"Checked when exported, by CasADi {ca.CasadiMeta.version()}: {parity.summary}"
    use = (
        "qdd = casadi.Function.load('forward_dynamics.casadi')(q, qd, tau, z) takes numbers or symbols: "
        "its derivatives, of any order, are CasADi's."
    )
    about = f"z is the friction state, {model.memory} numbers: casadi.DM(0, 1) where there are none."
    files = {f"{name}.casadi": _saved(function) for name, function in functions.items()}
    return with_readme(trained, "casadi", files, use=use, about=about, summary=[checked])


def casadi_functions(model: TrainedModel, entries: Mapping[str, EntryPoint]) -> dict[str, ca.Function]:
    """Return functions by name: SX expressions of bodies and friction, MX expressions of residual terms."""
    if not model.residuals:
        return expression_functions(model, entries)
    bases = {name: ENTRY_POINTS[name.removesuffix("_derivatives")] for name in entries}
    expressions = expression_functions(model, {base.name: base for base in bases.values()})
    functions: dict[str, ca.Function] = {}
    for name, entry in entries.items():
        base = bases[name]
        function = _with_residuals(base, model, expressions[base.name])
        functions[name] = function if base is entry else _derivatives(entry, function)
    return functions


def _with_residuals(entry: EntryPoint, model: TrainedModel, function: ca.Function) -> ca.Function:
    """Return a function of the states only, with the residual terms computed inside."""
    needed = residuals_needed(function)
    if not needed:
        return function
    arguments = function.mx_in()[: len(entry.inputs)]
    states = dict(zip(entry.inputs, arguments, strict=True))
    residuals = residual_values(model, states["q"], states.get("qd"))
    outputs = function.call(arguments + [residuals[name] for name in needed])
    return ca.Function(entry.name, arguments, outputs, list(entry.inputs), list(entry.outputs))


def _derivatives(entry: EntryPoint, function: ca.Function) -> ca.Function:
    """Return the derivatives of a function with respect to its first inputs, one per output of the entry point."""
    arguments = function.mx_in()
    (output,) = function.call(arguments)
    derivatives: list[ca.MX] = []
    for argument, _ in zip(arguments, entry.outputs, strict=False):
        # dense: callers expect n x n numbers
        derivatives.append(ca.densify(ca.jacobian(output, argument)))
    return ca.Function(entry.name, arguments, derivatives, list(entry.inputs), list(entry.outputs))


def _saved(function: ca.Function) -> bytes:
    # CasADi can write to files only
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "function.casadi")
        function.save(str(path))
        return path.read_bytes()


def called_by_state(functions: Mapping[str, ca.Function]) -> Called:
    """Return a function that calls CasADi functions, state by state."""

    def called(name: str, inputs: Values) -> Values:
        function = functions[name]
        states = zip(*(inputs[key] for key in function.name_in()), strict=True)
        # a loop: a map over states would be another function than the exported one
        results = [function.call(list(map(ca.DM, state))) for state in states]
        outputs: Values = {}
        for key, values in zip(function.name_out(), zip(*results, strict=True), strict=True):
            array = np.array([value.full() for value in values])
            # CasADi's vectors are columns
            outputs[key] = array[..., 0] if array.shape[-1] == 1 else array
        return outputs

    return called
