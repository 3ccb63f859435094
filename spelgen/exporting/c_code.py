"""A trained model -> a C99 header and source that need the standard math library alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import wrap

import casadi as ca

from spelgen.exporting.c_joint_functions import joint_function_source
from spelgen.exporting.c_networks import network_source
from spelgen.exporting.c_residual_calls import residual_calls
from spelgen.exporting.c_statements import statements
from spelgen.exporting.description import TrainedModel
from spelgen.exporting.entry_points import EntryPoint, entry_points, expression_function, residuals_needed
from spelgen.templates import render

_WIDTH = 118


@dataclass(frozen=True)
class CEntry:
    """An entry point in C."""

    name: str
    about: str
    signature: str
    definition: str
    operations: int


def c_entries(model: TrainedModel) -> tuple[CEntry, ...]:
    """Every entry point of the model in C."""
    return tuple(_entry(model, entry) for entry in entry_points(model))


def c_header(model: TrainedModel, entries: Sequence[CEntry], measured: str) -> str:
    """The header; ``measured`` tells the sizes of code and stack."""
    count = max(entries, key=lambda each: each.operations)
    facts = [
        f"{measured}; at most {count.operations} operations, in {count.name}, beside those of networks.",
    ]
    if model.servos is not None:
        facts.append(
            f"Joints are under position servos: tau of {model.name}_servo_torque goes into forward_dynamics, with the "
            f"command of {model.servos.delay:.4g} s before as u."
        )
    shape = (
        f": joint by joint, {model.bristles.count} each" if model.bristles else ": none, and z may be NULL"
    )
    return render(
        "model.h.jinja",
        title=_title(model),
        facts=[line for fact in facts for line in wrap(fact, _WIDTH - 4)],
        joints=", ".join(model.identifiers),
        name=model.name,
        upper=model.name.upper(),
        n=model.n,
        memory=model.memory,
        memory_note=shape,
        entries=entries,
    )


def c_source(model: TrainedModel, entries: Sequence[CEntry]) -> str:
    """The source."""
    return render(
        "model.c.jinja",
        title=_title(model),
        name=model.name,
        upper=model.name.upper(),
        residuals=[text for text in (network_source(model), joint_function_source(model)) if text],
        entries=entries,
    )


def _title(model: TrainedModel) -> str:
    return f"{model.name}: the dynamics of an arm of {model.n} joints, by spelgen ({model.preset})"


def _entry(model: TrainedModel, entry: EntryPoint) -> CEntry:
    function = expression_function(entry, model)
    prefix, real = f"{model.name}_", f"{model.name}_real"
    rows = f"{model.name.upper()}_N"
    parameters = [
        f"const {real} *z" if name == "z" else f"const {real} {name}[{rows}]" for name in entry.inputs
    ]
    for k, (name, _) in enumerate(entry.outputs):
        size = function.size1_out(k) * function.size2_out(k)
        parameters.append(f"{real} *{name}" if name.startswith("z_") else f"{real} {name}[{size}]")
    signature = f"void {prefix}{entry.name}({', '.join(parameters)})"
    shapes = ", ".join(
        f"{name} {_shape(function, k)} [{unit}]" for k, (name, unit) in enumerate(entry.outputs)
    )
    body = residual_calls(model, residuals_needed(function))
    unread = [name for name in entry.inputs if not _is_read(function, name) and not _read_in(body, name)]
    outputs = [name for name, _ in entry.outputs]
    lines = statements(function, function.name_in(), outputs)
    declarations = [line for line in (*body, *lines) if line.startswith("real ")]
    rest = [f"(void){name};" for name in unread] + [
        line for line in (*body, *lines) if not line.startswith("real ")
    ]
    if not rest or all(line.startswith("(void)") for line in rest):  # nothing is written
        rest += [f"(void){name};" for name in outputs]
    written = [row for line in (*declarations, *rest) for row in _indented(line)]
    return CEntry(
        name=entry.name,
        about=_comment(f"{entry.about}: {shapes}"),
        signature=_wrapped(signature),
        definition="\n".join([_wrapped(signature), "{", *written, "}"]),
        operations=sum(line.startswith("a") for line in lines),
    )


def _shape(function: ca.Function, index: int) -> str:
    rows, columns = function.size1_out(index), function.size2_out(index)
    return f"({rows}, {columns})" if columns > 1 else f"({rows})"


def _is_read(function: ca.Function, name: str) -> bool:
    """Whether any output depends on this input."""
    index = function.name_in().index(name)
    return any(function.jac_sparsity(k, index).nnz() for k in range(function.n_out()))


def _read_in(body: Sequence[str], name: str) -> bool:
    return any(f"({name}," in line or f" {name}," in line for line in body[1:])


def _comment(text: str) -> str:
    return "\n * ".join(wrap(text[0].upper() + text[1:] + ".", _WIDTH - 6))


def _wrapped(signature: str) -> str:
    """A signature in lines that end after a parameter."""
    first, *rest = signature.split(", ")
    lines = [first]
    for part in rest:
        longer = f"{lines[-1]}, {part}"
        if len(longer) < _WIDTH:
            lines[-1] = longer
        else:
            lines[-1] += ","
            lines.append(f"    {part}")
    return "\n".join(lines)


def _indented(line: str) -> list[str]:
    return wrap(line, _WIDTH, initial_indent="    ", subsequent_indent="        ")
