"""ModelSpec -> the emitted module's docstring: what the model is made of, and its joints."""

from __future__ import annotations

import json

from spelgen.labels import joint_ranges
from spelgen.spec import ModelSpec


def title(spec: ModelSpec) -> str:
    """What the module is, in a line."""
    n = len(spec.joints)
    return f"Port-Hamiltonian model of an arm with {n} joint{'s' * (n > 1)}, written by `spelgen build`."


def class_summary(spec: ModelSpec) -> str:
    """What the model consists of, in a line."""
    bodies = len(spec.bodies)
    made = f"{bodies} rigid bod{'ies' if bodies > 1 else 'y'} with trained inertial parameters"
    return f"The arm's dynamics: {made if bodies else _count(spec)}."


def _count(spec: ModelSpec) -> str:
    if spec.bodies:
        return f"{len(spec.bodies)} bodies with trained inertial parameters make mass matrix and potential energy"
    if spec.design.mass == "dense-3n":
        rows = 3 * len(spec.joints)
        return f"{rows * (rows + 1) // 2} learned functions of q make M^-1 over all axes"
    outputs, constants = len(spec.outputs), len(spec.constants)
    return (
        f"{outputs} learned function{'s' * (outputs != 1)} of q and {constants} constant{'s' * (constants != 1)} "
        "make the mass matrix"
    )


def summary(spec: ModelSpec) -> str:
    """What M and V are made of, and where their numbers start."""
    potential = (
        f"The potential energy depends on joint{'s' * (len(spec.potential) > 1)} {joint_ranges(spec.potential)}."
        if spec.potential
        else "Gravity does no work on it."
    )
    start = (
        "Sizes and starting values are the URDF's inertials."
        if spec.started_from_urdf
        else "The URDF's inertials are missing or impossible: sizes and starting values are those of 1 kg links."
    )
    parts = ["M"] * any(x.offset is not None for x in spec.outputs) + ["V"] * bool(spec.potential_series)
    sums = (
        f"\n{' and '.join(parts)}: Fourier series with trained coefficients, and a part for a network."
        if parts
        else ""
    )
    servos = (
        "\nG is the spring of position servos: tau = clip(kp (u - q) - kd qd), which stores 1/2 kp (q - u)^2."
        if spec.servos
        else ""
    )
    return f"{_count(spec)[0].upper()}{_count(spec)[1:]}.\n{potential}{sums}{servos}\n{start}"


def picture(spec: ModelSpec) -> str:
    """The lower triangle of M as text: what each entry depends on."""
    cells = {(row, column): _cell(kind, joints) for row, column, kind, joints in spec.entries}
    width = max(2, *(len(cell) for cell in cells.values()))
    lines = [
        "Mass matrix: the joints each entry depends on, C where it is constant, . where it is always zero.",
        "",
    ]
    for row in range(len(spec.joints)):
        line = "  ".join(cells[row, column].ljust(width) for column in range(row + 1))
        lines.append(f"    {line}".rstrip())
    return "\n".join(lines)


def _cell(kind: str, joints: tuple[int, ...]) -> str:
    if kind == "varying":
        return joint_ranges(joints)
    return "C" if kind == "constant" else "."


def joint_table(spec: ModelSpec) -> str:
    """Names, kinds, units and limits; names are JSON strings, whatever they hold."""
    lines = ["Joints, in the order of q, qd and tau:", ""]
    names = [json.dumps(joint.name) for joint in spec.joints]
    width = max(len(name) for name in names)
    for index, (joint, name) in enumerate(zip(spec.joints, names, strict=True), start=1):
        unit = "rad, Nm" if joint.kind == "revolute" else "m, N"
        limits = (
            "no limits"
            if joint.lower is None or joint.upper is None
            else f"{joint.lower:g} .. {joint.upper:g}"
        )
        lines.append(f"    {index}  {name.ljust(width)}  {joint.kind:9}  {unit:7}  {limits}")
    return "\n".join(lines)
