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
    beside = ", and residual networks" if _residual(spec) else ""
    return f"The arm's dynamics: {_bodies(spec) if spec.bodies else _count(spec)}{beside}."


def _bodies(spec: ModelSpec) -> str:
    count = len(spec.bodies)
    return f"{count} rigid bod{'ies' if count > 1 else 'y'} with trained inertial parameters"


def _count(spec: ModelSpec) -> str:
    if spec.bodies:
        return _bodies(spec)
    if spec.design.mass == "dense-3n":
        rows = 3 * len(spec.joints)
        return f"{rows * (rows + 1) // 2} learned functions of q make M^-1 over all axes"
    return f"{_functions(spec)} make the mass matrix"


def _functions(spec: ModelSpec) -> str:
    outputs, constants = len(spec.outputs), len(spec.constants)
    functions = f"{outputs} learned function{'s' * (outputs != 1)} of q"
    return f"{functions} and {constants} constant{'s' * (constants != 1)}"


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
    beside = f";\nresidual networks: {_functions(spec)} in M" if _residual(spec) else ""
    servos = (
        "\nG is the spring of position servos: tau = clip(kp (u - q) - kd qd), which stores 1/2 kp (q - u)^2."
        if spec.servos
        else ""
    )
    return f"{_count(spec)[0].upper()}{_count(spec)[1:]}{beside}.\n{potential}{servos}\n{start}"


def mass_entries(spec: ModelSpec) -> str:
    """What functions and constants make."""
    return f"{'R, what M has beside rigid bodies' if _residual(spec) else 'M without armature'}, (..., n, n)"


def _residual(spec: ModelSpec) -> bool:
    """Whether networks stand beside rigid bodies."""
    return bool(spec.bodies) and spec.design.net != "none"


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
