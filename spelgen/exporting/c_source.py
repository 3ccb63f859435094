"""A trained model -> a C99 header and source that need the standard math library alone."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import wrap

import casadi as ca

from spelgen.exporting.c_residuals import joint_function_source, network_source, residual_calls
from spelgen.exporting.c_statements import statements
from spelgen.exporting.description import TrainedModel
from spelgen.exporting.entry_points import EntryPoint, entry_points
from spelgen.exporting.model_expressions import expression_function, residuals_needed
from spelgen.templates import render

_WIDTH = 118  # characters of a line


@dataclass(frozen=True)
class CEntry:
    """An entry point in C."""

    name: str
    about: str
    signature: str
    definition: str
    operations: int


def c_entries(model: TrainedModel) -> tuple[CEntry, ...]:
    """Return every entry point of the model in C."""
    return tuple(_entry(model, entry) for entry in entry_points(model).values())


def c_header(model: TrainedModel, entries: Sequence[CEntry], sizes: str) -> str:
    """Return the header; ``sizes`` is a sentence on the sizes of code and stack."""
    # a bound for control loops: no branch depends on data
    longest = max(entries, key=lambda entry: entry.operations)
    facts = wrap(
        f"{sizes}; at most {longest.operations} operations, in {longest.name}, beside those of networks.",
        _WIDTH - 4,
    )
    if model.servos is not None:
        facts += wrap(
            f"Joints are under position servos: tau of {model.name}_servo_torque goes into forward_dynamics, with the "
            f"command of {model.servos.delay:.4g} s before as u.",
            _WIDTH - 4,
        )
    memory = ": none, and z may be NULL"
    if model.memory:
        memory = f": joint by joint, {model.reach.shape[1]} each"
    return render(
        "model.h.jinja",
        title=_title(model),
        facts=facts,
        joints=", ".join(model.identifiers),
        name=model.name,
        upper=model.name.upper(),
        n=model.n,
        memory=model.memory,
        memory_note=memory,
        entries=entries,
    )


def c_source(model: TrainedModel, entries: Sequence[CEntry]) -> str:
    """Return the source."""
    return render(
        "model.c.jinja",
        title=_title(model),
        name=model.name,
        upper=model.name.upper(),
        residuals=network_source(model) + joint_function_source(model),
        entries=entries,
    )


def _title(model: TrainedModel) -> str:
    return f"{model.name}: the dynamics of an arm of {model.n} joints, by spelgen ({model.preset})"


def _entry(model: TrainedModel, entry: EntryPoint) -> CEntry:
    function = expression_function(entry, model)
    signature = _signature(model, entry, function)
    # residuals first, for the statements read them
    residuals, calls = residual_calls(model, residuals_needed(function))
    variables, lines = statements(function, entry.output_names)
    text = " ".join((*calls, *lines))
    # the compiler would refuse a parameter that is not used
    unused = [name for name in (*entry.inputs, *entry.output_names) if not re.search(rf"\b{name}\b", text)]
    body = [f"(void){name};" for name in unused] + calls + lines
    if residuals or variables:
        # in single precision a small displacement would be lost beside what z is already
        kind = "double" if entry.name == "friction_step" else "real"
        body.insert(0, f"{kind} {', '.join((*residuals, *variables))};")
    # (rows) of a vector, (rows, columns) of a matrix
    shapes = []
    for k, (name, unit) in enumerate(entry.outputs):
        rows, columns = function.size_out(k)
        shape = f"({rows}, {columns})" if columns > 1 else f"({rows})"
        shapes.append(f"{name} {shape} [{unit}]")
    about = f"{entry.about[0].upper()}{entry.about[1:]}: {', '.join(shapes)}."
    written: list[str] = []
    for line in body:
        written += wrap(line, _WIDTH, initial_indent="    ", subsequent_indent="        ")
    return CEntry(
        name=entry.name,
        about="\n * ".join(wrap(about, _WIDTH - 6)),
        signature=signature,
        definition="\n".join([signature, "{", *written, "}"]),
        operations=len(lines) - function.nnz_out(),
    )


def _signature(model: TrainedModel, entry: EntryPoint, function: ca.Function) -> str:
    real, rows = f"{model.name}_real", f"{model.name.upper()}_N"
    parameters: list[str] = []
    for name in entry.inputs:
        # NULL where friction has no memory: no array of C is empty
        parameters.append("const double *z" if name == "z" else f"const {real} {name}[{rows}]")
    for k, name in enumerate(entry.output_names):
        size = function.numel_out(k)
        parameters.append(f"double *{name}" if name.startswith("z_") else f"{real} {name}[{size}]")
    text = f"void {model.name}_{entry.name}({', '.join(parameters)})"
    # lines end after a parameter: other spaces do not break
    text = text.replace(" ", "\xa0").replace(",\xa0", ", ")
    lines = wrap(text, _WIDTH, subsequent_indent="    ", break_long_words=False)
    return "\n".join(lines).replace("\xa0", " ")
