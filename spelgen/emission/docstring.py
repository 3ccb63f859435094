"""ModelSpec -> the emitted module's docstring: what the model is made of, and its joints."""

from __future__ import annotations

import json

from spelgen.labels import counted, joint_ranges, joints_in_ranges
from spelgen.spec import ModelSpec

_UNITS = {"revolute": "rad, Nm", "prismatic": "m, N"}


def title(spec: ModelSpec) -> str:
    """The module in a line."""
    joints = counted(len(spec.joints), "joint")
    return f"Port-Hamiltonian model of an arm with {joints}, written by `spelgen build`."


def class_summary(spec: ModelSpec) -> str:
    """The model in a line."""
    beside = ""
    if _has_residuals(spec):
        beside = ", and residual networks"
    return f"The arm's dynamics: {_mass(spec)}{beside}."


def _mass(spec: ModelSpec) -> str:
    """Return what M is made of."""
    if spec.bodies:
        count = counted(len(spec.bodies), "rigid body")
        return f"{count} with trained inertial parameters"
    if spec.design.mass == "dense-3n":
        rows = 3 * len(spec.joints)
        return f"{rows * (rows + 1) // 2} learned functions of q make M^-1 over all axes"
    return f"{_functions(spec)} make the mass matrix"


def _functions(spec: ModelSpec) -> str:
    functions = counted(len(spec.outputs), "learned function")
    return f"{functions} of q and {counted(len(spec.constants), 'constant')}"


def summary(spec: ModelSpec) -> str:
    """Return what M and V are made of, and where their numbers start."""
    mass = _mass(spec)
    text = mass[0].upper() + mass[1:]
    if _has_residuals(spec):
        text += f";\nresidual networks, zero unless a fit selects them: {_functions(spec)} in M"
    text += ".\n"
    if spec.potential:
        text += f"The potential energy depends on {joints_in_ranges(spec.potential)}.\n"
    else:
        text += "Gravity does no work on it.\n"
    if spec.servos:
        text += "G is the spring of position servos: tau = clip(kp (u - q) - kd qd), which stores 1/2 kp (q - u)^2.\n"
    if spec.started_from_urdf:
        return text + "Sizes and starting values are the URDF's inertials."
    missing = "The URDF's inertials are missing or impossible"
    return text + f"{missing}: sizes and starting values are those of 1 kg links."


def mass_entries(spec: ModelSpec) -> str:
    """Return what functions and constants make."""
    if _has_residuals(spec):
        return "R, what M has beside rigid bodies, (..., n, n)"
    return "M without armature, (..., n, n)"


def _has_residuals(spec: ModelSpec) -> bool:
    """Return whether networks stand beside rigid bodies."""
    return bool(spec.bodies) and spec.design.net != "none"


def picture(spec: ModelSpec) -> str:
    """The lower triangle of M as text: the joints that each entry depends on."""
    cells, width = {}, 2
    for row, column, kind, joints in spec.entries:
        cell = "."
        if kind == "varying":
            cell = joint_ranges(joints)
        elif kind == "constant":
            cell = "C"
        cells[row, column] = cell
        width = max(width, len(cell))
    lines = [
        "Mass matrix: the joints each entry depends on, C where it is constant, . where it is always zero.",
        "",
    ]
    for row in range(len(spec.joints)):
        line = "  ".join(cells[row, column].ljust(width) for column in range(row + 1))
        lines.append(f"    {line}".rstrip())
    return "\n".join(lines)


def joint_table(spec: ModelSpec) -> str:
    """Names, kinds, units and limits; names are JSON strings, whatever they hold."""
    lines = ["Joints, in the order of q, qd and tau:", ""]
    names = [json.dumps(joint.name) for joint in spec.joints]
    width = max(map(len, names))
    for index, (joint, name) in enumerate(zip(spec.joints, names, strict=True), start=1):
        limits = "no limits"
        if joint.lower is not None and joint.upper is not None:
            limits = f"{joint.lower:g} .. {joint.upper:g}"
        unit = _UNITS[joint.kind]
        lines.append(f"    {index}  {name.ljust(width)}  {joint.kind:9}  {unit:7}  {limits}")
    return "\n".join(lines)
