"""C code of the residual terms of a model, which are added to the rigid bodies.

Networks are evaluated by loops over tables of weights. Residual terms of a single joint are splines (tables with one
polynomial per interval) and ripple (harmonics k = 1, 2, ... of a frequency f, computed as powers of exp(i f q)). The C
code of an entry point first calls the functions that compute its residual terms (see `residual_expressions`).
"""

from collections.abc import Mapping, Sequence
from textwrap import wrap

import numpy as np
from scipy.interpolate import BSpline, PPoly

from spelgen.exporting.description import TrainedModel, spline_energy
from spelgen.exporting.model_expressions import RESIDUAL
from spelgen.exporting.residual_expressions import residual_symbols
from spelgen.templates import render

_WIDTH = 112  # maximum number of characters in a line of a C table

_CALLS = (
    ("mass_rates(encoded, qd", ("mass", "rate", "kinetic")),
    ("mass_values(encoded", ("mass",)),
    ("potential_gradient(encoded", ("gravity",)),
    ("potential_value(encoded", ("energy",)),
    ("joint_torques(q", ("torque",)),
    ("joint_energies(q", ("torque_energy",)),
    ("friction_factors(q", ("factor",)),
)
"""Calls, and the symbols that each computes. A call is needed if no call before it computes its last symbol."""


def residual_calls(model: TrainedModel, names: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the C declarations of the residual terms ``names``, and the C calls that compute these terms.

    The C function of an entry point begins with these lines, since its other statements depend on the residual terms.
    names: keys of `residual_symbols`.
    """
    uncomputed = set(names)
    symbols = residual_symbols(model)
    variables = []
    calls = []
    for call, computed in _CALLS:
        if computed[-1] not in uncomputed:
            continue
        uncomputed.difference_update(computed)
        arguments = []
        for name in computed:
            variables.append(f"{RESIDUAL}{name}[{symbols[name].numel()}]")
            arguments.append(RESIDUAL + name)
        calls.append(f"{call}, {', '.join(arguments)});")
    # The networks of M and V have the same inputs, so cos q and sin q are computed once.
    if "(encoded" in "".join(calls):
        variables.insert(0, "encoded[ENCODED]")
        calls.insert(0, "encode(q, encoded);")
    return variables, calls


def network_source(model: TrainedModel) -> list[str]:
    """Return a list with the C source of all networks; [] if the model has no networks."""
    n, residuals = model.n, model.residuals
    named = {"mass": residuals.mass, "potential": residuals.potential}
    networks = {name: network for name, network in named.items() if network is not None}
    if not networks:
        return []
    tables = []
    shapes = {}
    for name, network in networks.items():
        shapes[name] = [weight.shape for weight in network.weights]
        for k, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True), start=1):
            tables += _layer_tables(f"{name}_{k}", weight, bias)
    text = render(
        "networks.c.jinja",
        n=n,
        hidden=max(map(len, shapes.values())) - 1,
        # All networks use the same buffers, so the buffers have the size of the widest layer.
        width=max(max(shape) for layers in shapes.values() for shape in layers),
        encoded=3 * n,
        tables=tables,
        networks=shapes,
        entries=residuals.entries,
    )
    return [text.rstrip()]


def _layer_tables(name: str, weight: np.ndarray, bias: np.ndarray) -> list[str]:
    """Return the C tables of a layer: biases, weights, and the first and last output that each input affects.

    For each input, only the weights from the first to the last nonzero weight are stored, since masked networks have
    blocks of zero weights.

    Args:
        name: prefix of the names of the tables.
        weight: weights of the layer, (outputs, inputs).
        bias: biases of the layer, (outputs,).
    """
    is_used = weight != 0
    first = is_used.argmax(axis=0)
    last = np.where(is_used.any(axis=0), len(weight) - is_used[::-1].argmax(axis=0), 0)
    packed = [column[a:b] for column, a, b in zip(weight.T, first, last, strict=True)]
    tables = {"bias": bias, "weight": np.concatenate(packed), "first": first, "last": last}
    return [_table(f"{name}_{key}", values) for key, values in tables.items()]


def joint_function_source(model: TrainedModel) -> list[str]:
    """Return a list with the C source of the residual terms of single joints; [] if the model has none.

    These terms are torque splines, torque ripple, and friction factors.
    """
    residuals = model.residuals
    torque, factor = residuals.torque, residuals.friction
    if not (residuals.has_torque or factor):
        return []
    tables = []
    intervals = 0
    for name, splines in (("torque", torque), ("factor", factor)):
        if splines:
            polynomials = list(map(_polynomials, splines.values()))
            intervals = len(polynomials[0])
            tables.append(_table(f"{name}_pieces", np.concatenate(polynomials)))
    if torque:
        # The table has the potential energy at the start of each interval. Within an interval, the C code integrates
        # the torque.
        energies = [spline_energy(spline)(spline.t[3:-4]) for spline in torque.values()]
        tables.append(_table("torque_energy", np.concatenate(energies)))
    for k, ripple in enumerate(residuals.ripple, start=1):
        tables.append(_table(f"ripple_{k}", np.stack([ripple.cosines, ripple.sines], axis=1)))
    text = render(
        "joint_functions.c.jinja",
        n=model.n,
        intervals=intervals,
        tables=tables,
        torque=_spline_fields(torque),
        factor=_spline_fields(factor),
        ripple=residuals.ripple,
    )
    return [text.rstrip()]


def _polynomials(spline: BSpline) -> np.ndarray:
    """Return the polynomials of a cubic spline, (intervals, 4): coefficients of 1, s, s^2, s^3 in each interval.

    s increases from 0 to 1 within an interval between two knots.
    """
    curve = PPoly.from_spline((np.arange(len(spline.t)), spline.c, 3))
    # The first three and the last three intervals of a cubic B-spline's knots are outside of its range and are removed.
    return np.asarray(curve.c[::-1, 3 : len(spline.c)].T)


def _spline_fields(splines: Mapping[int, BSpline]) -> list[str]:
    """Return one C initialiser per spline: "joint, first knot, knot spacing". splines: {index of a joint: spline}."""
    spacings = [float(np.ptp(spline.t) / (len(spline.t) - 1)) for spline in splines.values()]
    firsts = [float(spline.t[3]) for spline in splines.values()]
    return [f"{joint}, {x!r}, {h!r}" for joint, x, h in zip(splines, firsts, spacings, strict=True)]


def _table(name: str, values: np.ndarray) -> str:
    """Return the C definition of a constant array `name` with unrounded values, (rows,) or (rows, columns)."""
    scalar = "short" if values.dtype.kind == "i" else "real"
    # repr keeps all digits, so that the C compiler gets the same double.
    size = ""
    numbers = ", ".join(map(repr, values.tolist()))
    if values.ndim == 2:
        size = f"[{values.shape[1]}]"
        # In C, braces enclose each row of a matrix.
        numbers = numbers.replace("[", "{").replace("]", "}")
    lines = wrap(numbers, _WIDTH, initial_indent="    ", subsequent_indent="    ")
    return "\n".join([f"static UNUSED const {scalar} {name}[]{size} = {{", *lines, "};"])
