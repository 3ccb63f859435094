"""C99 header and source of a trained model, which need only the standard math library.

Networks are evaluated by loops over tables of weights. Residual terms of a single joint are splines (tables with one
polynomial per interval) and ripple (harmonics k = 1, 2, ... of a frequency f, computed as powers of exp(i f q)). The C
code of an entry point first calls the functions that compute its residual terms (see `model_expressions`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from textwrap import wrap

import casadi as ca
import numpy as np
from scipy.interpolate import BSpline, PPoly

from spelgen.exporting.describe import TrainedModel, spline_energy
from spelgen.exporting.model_expressions import (
    RESIDUAL,
    expression_functions,
    residual_symbols,
    residuals_needed,
)
from spelgen.exporting.parity import EntryPoint
from spelgen.templates import render

_WIDTH = 118  # maximum number of characters in a line of a C function
FRICTION_STATES = ("z", "z_next", "z_start", "low", "high")
"""Inputs and outputs that are friction states, of type double; all others are of type ``real``."""
# C expressions of the operations of CasADi: {0} and {1} are operands. SIN, COS and other macros are the functions for
# float or double. tanh is used only for the friction state, which is always double.
_FORMS = {
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "{0} + {0}",
    ca.OP_INV: "R(1) / {0}",
    ca.OP_SIN: "SIN({0})",
    ca.OP_COS: "COS({0})",
    ca.OP_TANH: "tanh({0})",
    ca.OP_EXP: "EXP({0})",
    ca.OP_FABS: "MAX({0}, -{0})",
    ca.OP_SIGN: "({0} > 0) - ({0} < 0)",
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_FMAX: "MAX({0}, {1})",
    ca.OP_FMIN: "MIN({0}, {1})",
    ca.OP_SQRT: "SQRT({0})",
}
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


@dataclass(frozen=True)
class CFunction:
    """An entry point, a function of the model such as inverse_dynamics, in C.

    Attributes:
        entry: the entry point.
        symbol: name of the C function.
        shapes: {output: its shape, (rows,) or (rows, columns)}.
        about: text of the comment above the function.
        signature: C declaration of the function, without a semicolon.
        definition: C definition of the function.
        operations: upper bound of the number of arithmetic operations of a call, without networks.
    """

    entry: EntryPoint
    symbol: str
    shapes: dict[str, tuple[int, ...]]
    about: str
    signature: str
    definition: str
    operations: int


def c_functions(model: TrainedModel, entries: Mapping[str, EntryPoint]) -> list[CFunction]:
    """Return the C functions of a model for the given entry points (functions such as inverse_dynamics)."""
    expressions = expression_functions(model, entries)
    return [c_function(model, entry, expressions[name]) for name, entry in entries.items()]


def write_c(model: TrainedModel, functions: Sequence[CFunction], folder: Path) -> Path:
    """Write the C header and source of a model into a folder; return the path of the source."""
    source = folder / f"{model.name}.c"
    for suffix, text in c_texts(model, functions).items():
        source.with_suffix(suffix).write_text(text)
    return source


def c_texts(model: TrainedModel, functions: Sequence[CFunction]) -> dict[str, str]:
    """Return the C header and source with the given functions of a model as {".h": text, ".c": text}."""
    # The header states the number of operations of the longest function. It is an upper bound for all inputs, since the
    # code has no branches that depend on data.
    longest = max(functions, key=lambda function: function.operations)
    facts = [f"At most {longest.operations} operations, in {longest.entry.name}, without networks."]
    if model.servos is not None:
        facts += wrap(
            f"Joints are under position servos: tau of {model.name}_servo_torque goes into forward_dynamics, with the "
            f"command of {model.servos.delay:.4g} s before as u.",
            _WIDTH - 4,
        )
    note = (
        f": joint by joint, {model.breakaway.shape[1]} each" if model.memory else ": none, and z may be NULL"
    )
    context = {
        "name": model.name,
        "upper": model.name.upper(),
        "n": model.n,
        "functions": functions,
        "facts": facts,
        "joints": ", ".join(model.joint_labels),
        "memory": model.memory,
        "memory_note": note,
        "residuals": network_source(model) + joint_function_source(model),
    }
    return {suffix: render(f"model{suffix}.jinja", **context) for suffix in (".h", ".c")}


def c_function(model: TrainedModel, entry: EntryPoint, function: ca.Function) -> CFunction:
    """Return the C function of an entry point, which computes the outputs of a CasADi function.

    entry: function of the model, such as inverse_dynamics. function: CasADi function of scalar expressions, made by
    `named_function`. Residual terms of the model are inputs of `function`; the C function computes them by calls of
    other C functions.
    """
    # The C function computes the residual terms first, since its other statements depend on them.
    residuals, calls = residual_calls(model, residuals_needed(function))
    variables, lines = _statements(function, list(entry.outputs))
    # Casts to void prevent compiler warnings about unused parameters.
    body = [" ".join(f"(void){name};" for name in (*entry.inputs, *entry.outputs))]
    if residuals or variables:
        # The friction state is updated in double precision: in single precision, the sum z + dq would lose small
        # displacements dq.
        scalar = "double" if entry.name == "friction_step" else "real"
        body.append(f"{scalar} {', '.join((*residuals, *variables))};")
    sizes = dict.fromkeys(entry.inputs, f"{model.name.upper()}_N") | {"load": "10"}
    parameters = [f"const {_parameter(model, name, sizes[name])}" for name in entry.inputs]
    shapes: dict[str, tuple[int, ...]] = {}
    results = []
    for k, (name, unit) in enumerate(entry.outputs.items()):
        rows, columns = function.size_out(k)
        shapes[name] = (rows, columns) if columns > 1 else (rows,)
        parameters.append(_parameter(model, name, str(rows * columns)))
        results.append(f"{name} ({', '.join(map(str, shapes[name]))}) [{unit}]")
    # The comment above the function in the header states the shapes and units of the results.
    about = f"{entry.about[0].upper()}{entry.about[1:]}: {', '.join(results)}."
    symbol = f"{model.name}_{entry.name}"
    signature = f"void {symbol}(\n    " + ",\n    ".join(parameters) + ")"
    wrapped = [
        wrap(x, _WIDTH, initial_indent="    ", subsequent_indent="        ") for x in body + calls + lines
    ]
    return CFunction(
        entry=entry,
        symbol=symbol,
        shapes=shapes,
        about="\n * ".join(wrap(about, _WIDTH - 6)),
        signature=signature,
        definition="\n".join([signature, "{", *chain(*wrapped), "}"]),
        operations=len(lines) - function.nnz_out(),
    )


def _parameter(model: TrainedModel, name: str, size: str) -> str:
    """Return the C declaration of the array `name`, an argument of a C function of the model.

    model: its name is the prefix of the C type. size: number of entries of the array, a C expression.
    """
    # C has no arrays of length zero: z is a pointer, which may be NULL for a model without bristles.
    return f"double *{name}" if name in FRICTION_STATES else f"{model.name}_real {name}[{size}]"


def _statements(function: ca.Function, outputs: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the variables and the statements of a C function, one statement per CasADi instruction.

    The C arrays are row-major; their names are the names of the inputs of `function` and ``outputs``. The outputs of
    `function` are dense, so that each entry of an array is assigned exactly once. A variable is a slot of CasADi's work
    vector: it is assigned several intermediate results in turn.
    """
    inputs = function.name_in()
    # CasADi numbers the entries of a matrix in column-major order, the C arrays are row-major.
    shapes = [function.size_out(k) for k in range(function.n_out())]
    variables: dict[str, None] = {}
    lines = []
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        reads, writes = function.instruction_input(k), function.instruction_output(k)
        if operation == ca.OP_OUTPUT:
            output, index = writes
            rows, columns = shapes[output]
            # `row_by_row`: index in the row-major C array
            row_by_row = index % rows * columns + index // rows
            lines.append(f"{outputs[output]}[{row_by_row}] = a{reads[0]};")
            continue
        if operation == ca.OP_INPUT:
            value = f"{inputs[reads[0]]}[{reads[1]}]"
        elif operation == ca.OP_CONST:
            # the C literal `value` has all digits of the constant
            value = f"R({function.instruction_constant(k)!r})"
        else:
            value = _FORMS[operation].format(*(f"a{slot}" for slot in reads))
        # The dict `variables` is used as an ordered set: its keys are unique and in the order of the first assignments.
        variables[f"a{writes[0]}"] = None
        lines.append(f"a{writes[0]} = {value};")
    return list(variables), lines


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
    lines = wrap(numbers, _WIDTH - 6, initial_indent="    ", subsequent_indent="    ")
    return "\n".join([f"static UNUSED const {scalar} {name}[]{size} = {{", *lines, "};"])
