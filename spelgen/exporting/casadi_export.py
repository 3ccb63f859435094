"""Export with ``--to casadi``: one file with a CasADi function for each entry point."""

import tempfile
from collections.abc import Mapping
from pathlib import Path

import casadi as ca
import numpy as np
from scipy.interpolate import BSpline

from spelgen.exporting.describe import Residuals, SigmoidNetwork, Trained, TrainedModel, spline_energy
from spelgen.exporting.exported import Exported, with_readme
from spelgen.exporting.model_expressions import expression_functions, residuals_needed
from spelgen.exporting.parity import Called, EntryPoint, Values, check_parity
from spelgen.exporting.rigid_expressions import constant
from spelgen.exporting.tuning import TUNING


def export_casadi(trained: Trained) -> Exported:
    """Return one CasADi file per entry point, a function of the model such as inverse_dynamics, with a README.

    Raises RunError if results of a function and of the model differ.
    """
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
    """Return {name of an entry point, such as inverse_dynamics: CasADi function}.

    Rigid bodies and friction are SX (scalar) expressions; residual terms are MX (matrix) expressions.
    """
    functions = {}
    for name, function in expression_functions(model, entries).items():
        functions[name] = _with_residuals(entries[name], model, function)
    return functions


def _with_residuals(entry: EntryPoint, model: TrainedModel, function: ca.Function) -> ca.Function:
    """Return a CasADi function that computes the residual terms of a model and passes them to ``function``.

    The result has the inputs of the entry point ``entry``. ``function`` has these inputs, then the residual terms. If
    it depends on no residual terms, it is returned unchanged: a pure SX function is faster than an MX function that
    calls it.
    """
    needed = residuals_needed(function)
    if not needed:
        return function
    arguments = function.mx_in()[: len(entry.inputs)]
    states = dict(zip(entry.inputs, arguments, strict=True))
    residuals = _residual_values(model, states["q"], states.get("qd"))
    outputs = function.call(arguments + [residuals[name] for name in needed])
    return ca.Function(entry.name, arguments, outputs, list(entry.inputs), list(entry.outputs))


def _saved(function: ca.Function) -> bytes:
    # The function is saved to a file and read again, since CasADi cannot serialise a function to memory.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "function.casadi")
        function.save(str(path))
        return path.read_bytes()


def called_by_state(functions: Mapping[str, ca.Function]) -> Called:
    """Return a function for `check_parity`: it calls a named CasADi function per state and stacks the results."""

    def called(name: str, inputs: Values) -> Values:
        function = functions[name]
        states = zip(*(inputs[key] for key in function.name_in()), strict=True)
        # A loop over states calls the exported function itself; CasADi's `map` would make another function.
        results = [function.call([ca.DM(value.ravel()) for value in state]) for state in states]
        outputs = {}
        for key, values in zip(function.name_out(), zip(*results, strict=True), strict=True):
            array = np.array([value.full() for value in values])
            # CasADi returns vectors as columns: the second axis, of length one, is removed.
            outputs[key] = array[..., 0] if array.shape[-1] == 1 else array
        return outputs

    return called


def _residual_values(model: TrainedModel, q: ca.MX, qd: ca.MX | None) -> dict[str, ca.MX]:
    """Return the residual terms as expressions in q and qd: {name, such as ``gravity``: expression}.

    The names are listed in `model_expressions`. q, qd: symbols, (n, 1) each; qd: None if no term that depends on
    velocity is needed.
    """
    residuals = model.residuals
    values = {}
    encoded = ca.vertcat(ca.cos(q), ca.sin(q), q)
    if residuals.mass is not None:
        mass = values["mass"] = _network(residuals.mass, encoded)
        if qd is not None:
            values["rate"] = ca.jtimes(mass, q, qd)
            values["kinetic"] = ca.jtimes(mass, q, _in_kinetic_energy(model, qd), True)
    if residuals.potential is not None:
        values["energy"] = _network(residuals.potential, encoded)
        # The gradient of V in reverse mode takes about as long as one evaluation of the network.
        values["gravity"] = ca.gradient(values["energy"], q)
    # The torque of splines and ripple is computed as the derivative of their potential energy, so that torque and
    # energy are consistent.
    if residuals.has_torque:
        values["torque_energy"] = _torque_energy(residuals, q)
        values["torque"] = ca.gradient(values["torque_energy"], q)
    if residuals.friction:
        factors = [_spline(spline, q[joint]) for joint, spline in residuals.friction.items()]
        values["factor"] = ca.vertcat(*factors)
    return values


def _in_kinetic_energy(model: TrainedModel, qd: ca.MX) -> ca.MX:
    """Return the coefficients c, (m, 1), with which the kinetic energy 1/2 qd^T R qd is the product c^T r.

    R is the residual term of M; r, (m, 1), are the m nonzero entries in its lower triangle. qd: (n, 1) [rad/s, m/s].
    """
    products = []
    for row, column in model.residuals.entries:
        # In 1/2 qd^T R qd, the term of an off-diagonal entry R_ij occurs twice, as R_ij and R_ji: its coefficient is
        # qd_i qd_j without the factor 1/2.
        weight = 0.5 if row == column else 1.0
        products.append(weight * qd[row] * qd[column])
    return ca.vertcat(*products)


def _network(network: SigmoidNetwork, encoded: ca.MX) -> ca.MX:
    """Return the outputs of a residual network, (outputs, 1), for its inputs cos q, sin q and q, (3 n, 1)."""
    layer = encoded
    for weight, bias in zip(network.weights[:-1], network.biases[:-1], strict=True):
        # CasADi has no sigmoid function, so it is computed from exp.
        layer = 1 / (1 + ca.exp(-(constant(weight) @ layer + bias)))
    return constant(network.weights[-1]) @ layer + network.biases[-1]


def _torque_energy(residuals: Residuals, q: ca.MX) -> ca.MX:
    """Return the potential energy (1, 1) [J] at q (n, 1) of all torque splines and torque ripple."""
    energy = ca.MX(0)
    for joint, spline in residuals.torque.items():
        energy += _spline(spline_energy(spline), q[joint])
    for ripple in residuals.ripple:
        frequencies = ripple.frequency * np.arange(1, len(ripple.cosines) + 1)
        phase = frequencies * q[ripple.joint]
        energy += ca.dot(ripple.cosines / frequencies, ca.sin(phase))
        energy -= ca.dot(ripple.sines / frequencies, ca.cos(phase))
    return energy


def _spline(spline: BSpline, q: ca.MX) -> ca.MX:
    """Return the value (1, 1) of a spline at the position q (1, 1) of a joint.

    Outside of the knots it is the value at the nearest end: zero for a torque or friction spline, a constant for an
    energy.
    """
    knots, degree = spline.t, spline.k
    # CasADi's bspline extrapolates the last polynomial, but the model's splines are constant there.
    inside = ca.fmin(ca.fmax(q, knots[degree]), knots[-degree - 1])
    return ca.bspline(inside, ca.DM(spline.c), [knots.tolist()], [degree], 1, {})
