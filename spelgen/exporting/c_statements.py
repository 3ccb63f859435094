"""A CasADi function of scalars -> the statements of a C function."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

# friction's memory is double in any case: tanh has no form for float
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


def statements(function: ca.Function, outputs: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the variables of a C function and its statements, one a step, in the order that CasADi has.

    It reads arrays of the names of the function's inputs and writes ``outputs``, matrices row by row; outputs are
    dense, so that each of their numbers is written once.
    """
    # CasADi reuses slots: as few variables as live at a time
    inputs = function.name_in()
    shapes = [function.size_out(k) for k in range(function.n_out())]
    variables: dict[str, None] = {}
    lines: list[str] = []
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        reads, writes = function.instruction_input(k), function.instruction_output(k)
        if operation == ca.OP_OUTPUT:
            output, index = writes
            rows, columns = shapes[output]
            row_by_row = index % rows * columns + index // rows  # CasADi has column by column
            lines.append(f"{outputs[output]}[{row_by_row}] = a{reads[0]};")
            continue
        if operation == ca.OP_INPUT:
            value = f"{inputs[reads[0]]}[{reads[1]}]"
        elif operation == ca.OP_CONST:
            value = f"R({function.instruction_constant(k)!r})"  # with all its digits
        else:
            value = _FORMS[operation].format(*(f"a{slot}" for slot in reads))
        # a dict keeps the order in which CasADi first writes them
        variables[f"a{writes[0]}"] = None
        lines.append(f"a{writes[0]} = {value};")
    return list(variables), lines
