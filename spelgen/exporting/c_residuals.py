"""The part of a model beside its rigid bodies as C: networks as loops over tables, functions of single joints.

Splines are a polynomial for each interval, harmonics turn a phasor. An entry point calls what its expressions need.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import wrap

import numpy as np
from scipy.interpolate import BSpline, PPoly

from spelgen.exporting.description import TrainedModel, spline_energy
from spelgen.exporting.model_expressions import RESIDUAL
from spelgen.exporting.residual_expressions import residual_symbols
from spelgen.templates import render

_WIDTH = 112  # characters of a line

_CALLS = (
    (("first", "second"), "mass_jets(q", ("mass", "first", "second")),
    (("rate", "kinetic"), "mass_rates(encoded, qd", ("mass", "rate", "kinetic")),
    (("mass",), "mass_values(encoded", ("mass",)),
    (("stiffness",), "potential_jets(q", ("gravity", "stiffness")),
    (("gravity",), "potential_gradient(encoded", ("gravity",)),
    (("energy",), "potential_value(encoded", ("energy",)),
    (("torque", "torque_slope"), "joint_torques(q", ("torque", "torque_slope")),
    (("torque_energy",), "joint_energies(q", ("torque_energy",)),
    (("factor", "factor_slope"), "friction_factors(q", ("factor", "factor_slope")),
)
"""By what is needed: the call, and all that it computes; the first call that computes a residual is taken for it."""


def residual_calls(model: TrainedModel, names: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the variables, and the calls that compute these residuals of q, and of qd where they need it."""
    missing = set(names)
    symbols = residual_symbols(model)
    variables: list[str] = []
    calls: list[str] = []
    for needed, call, computed in _CALLS:
        # jets stand first: what they compute is not computed again
        if not missing.intersection(needed):
            continue
        missing.difference_update(computed)
        arguments = []
        for name in computed:
            variables.append(f"{RESIDUAL}{name}[{symbols[name].numel()}]")
            arguments.append(RESIDUAL + name)
        calls.append(f"{call}, {', '.join(arguments)});")
    if "(encoded" in "".join(calls):
        variables.insert(0, "encoded[ENCODED]")
        calls.insert(0, "encode(q, encoded);")
    return variables, calls


def network_source(model: TrainedModel) -> list[str]:
    """Return the C text of all networks, nothing where there are none."""
    n, residuals = model.n, model.residuals
    named = {"mass": residuals.mass, "potential": residuals.potential}
    networks = {name: network for name, network in named.items() if network is not None}
    if not networks:
        return []
    tables: list[str] = []
    shapes: dict[str, list[tuple[int, ...]]] = {}
    for name, network in networks.items():
        shapes[name] = [weight.shape for weight in network.weights]
        for k, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True), start=1):
            tables += _layer_tables(f"{name}_{k}", weight, bias)
    text = render(
        "networks.c.jinja",
        n=n,
        hidden=max(map(len, shapes.values())) - 1,
        # buffers are of one size, that of the widest layer
        width=max(max(shape) for layers in shapes.values() for shape in layers),
        encoded=3 * n,
        lanes=1 + n + n * (n + 1) // 2,
        tables=tables,
        networks=shapes,
        entries=residuals.entries,
    )
    return [text.rstrip()]


def _layer_tables(name: str, weight: np.ndarray, bias: np.ndarray) -> list[str]:
    """Return tables of bias, weight by input from first to last that is not zero, first and last."""
    first: list[int] = []
    last: list[int] = []
    packed: list[np.ndarray] = []
    for column in weight.T:
        # masked networks: an input reaches a block of the outputs
        nonzero = np.flatnonzero(column).tolist() or [0, -1]
        first.append(nonzero[0])
        last.append(nonzero[-1] + 1)
        packed.append(column[first[-1] : last[-1]])
    return [
        _table(f"{name}_bias", bias),
        _table(f"{name}_weight", np.concatenate(packed)),
        _table(f"{name}_first", np.array(first)),
        _table(f"{name}_last", np.array(last)),
    ]


def joint_function_source(model: TrainedModel) -> list[str]:
    """Return the C text of all functions of single joints, nothing where there are none."""
    residuals = model.residuals
    torque, factor = residuals.torque, residuals.friction
    if not (residuals.has_torque or factor):
        return []
    tables: list[str] = []
    intervals = 0
    for name, splines in (("torque", torque), ("factor", factor)):
        if splines:
            pieces = list(map(_pieces, splines.values()))
            intervals = len(pieces[0])
            tables.append(_table(f"{name}_pieces", np.concatenate(pieces)))
    if torque:
        # up to where each interval begins
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


def _pieces(spline: BSpline) -> np.ndarray:
    """Return coefficients by interval and power of s, from 0 to 1 on it, (intervals, 4)."""
    curve = PPoly.from_spline((np.arange(len(spline.t)), spline.c, 3))
    # intervals outside of these have no meaning
    pieces: np.ndarray = curve.c[::-1, 3 : len(spline.c)].T
    return pieces


def _spline_fields(splines: Mapping[int, BSpline]) -> list[str]:
    """Return by spline: joint, start, spacing."""
    fields: list[str] = []
    for joint, spline in splines.items():
        spacing = np.ptp(spline.t) / (len(spline.t) - 1)
        fields.append(f"{joint}, {float(spline.t[3])!r}, {float(spacing)!r}")
    return fields


def _table(name: str, values: np.ndarray) -> str:
    """Return a constant array of C, numbers with all their digits."""
    kind = "short" if values.dtype.kind == "i" else "real"
    size = ""
    numbers = ", ".join(map(repr, values.tolist()))
    if values.ndim == 2:
        size = f"[{values.shape[1]}]"
        # rows in braces of their own
        numbers = numbers.replace("[", "{").replace("]", "}")
    lines = wrap(numbers, _WIDTH, initial_indent="    ", subsequent_indent="    ")
    return "\n".join([f"static UNUSED const {kind} {name}[]{size} = {{", *lines, "};"])
