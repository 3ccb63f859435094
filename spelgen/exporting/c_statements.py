"""A CasADi function of scalars -> the statements of a C function: one a step, in the order that CasADi found."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

_UNARY = {
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "{0} + {0}",
    ca.OP_INV: "R(1) / {0}",
    ca.OP_SIN: "SIN({0})",
    ca.OP_COS: "COS({0})",
    ca.OP_TANH: "TANH({0})",
    ca.OP_EXP: "EXP({0})",
    ca.OP_FABS: "FABS({0})",
    ca.OP_SIGN: "SIGN({0})",
}
_BINARY = {
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_FMAX: "FMAX({0}, {1})",
}


def statements(function: ca.Function, inputs: Sequence[str], outputs: Sequence[str]) -> list[str]:
    """The body of a C function that reads these arrays and writes those; matrices stand row by row.

    Outputs are dense, so that each of their numbers is written once.
    """
    found: list[str] = []
    places = [_row_by_row(function.sparsity_out(k)) for k in range(function.n_out())]
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        reads, writes = function.instruction_input(k), function.instruction_output(k)
        if operation == ca.OP_OUTPUT:
            found.append(f"{outputs[writes[0]]}[{places[writes[0]][writes[1]]}] = a{reads[0]};")
        elif operation == ca.OP_INPUT:
            found.append(f"a{writes[0]} = {inputs[reads[0]]}[{reads[1]}];")
        elif operation == ca.OP_CONST:
            found.append(f"a{writes[0]} = {number(function.instruction_constant(k))};")
        else:
            form = _UNARY.get(operation) or _BINARY[operation]
            found.append(f"a{writes[0]} = {form.format(*(f'a{each}' for each in reads))};")
    slots = sorted({line.split(" ")[0] for line in found if line.startswith("a") and "[" not in line[:6]})
    return [*_declared(slots), *found]


def number(value: float) -> str:
    """A constant with all its digits."""
    return f"R({value!r})" if value != int(value) or abs(value) > 1e9 else f"R({int(value)})"


def _declared(slots: Sequence[str]) -> list[str]:
    rows = [slots[start : start + 16] for start in range(0, len(slots), 16)]
    return [f"real {', '.join(row)};" for row in rows]


def _row_by_row(sparsity: ca.Sparsity) -> list[int]:
    """Where CasADi's numbers, column by column, stand row by row."""
    return [
        row * sparsity.size2() + column
        for column in range(sparsity.size2())
        for row in range(sparsity.size1())
    ]
