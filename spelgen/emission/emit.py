"""ModelSpec -> the source text of the emitted module. Pure: the same spec gives the same bytes.

Text from a URDF reaches the module as identifiers and as JSON strings inside its raw docstring, never as
code.
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from dataclasses import asdict

from spelgen.labels import joint_ranges
from spelgen.rendering import render
from spelgen.spec import JointSpec, ModelSpec

_WIDTH = 100
_LEAST_UNITS = 4
_POTENTIAL_SHARE = 0.5
_FRICTION_HIDDEN = 8
_FRICTION_START = 0.35
_SLOW = 0.03
_SLOWEST = 1e-3
_NETWORK_SHARE = 0.1
_INPUT = ("joint", "motor", "value", "trained")
_PLACE_SHARE = 0.1
_LEAST_ROTOR = 0.01
_GRID = 4
_KAN_SHARE = 0.25
_LEAST_KAN_UNITS = 2
_FRICTION_AXES = {"per-joint": 0, "dense-n": 1, "dense-3n": 3}
"""Of each joint, over which one matrix D extends."""


def emit(spec: ModelSpec) -> str:
    """The Python source of the module that ``spec`` describes; it needs torch alone."""
    design = spec.design
    if design.mass == "closed-form":
        return _closed_form(spec)
    return render(
        "module.py.jinja",
        **_common(spec),
        joints=_table("JOINTS = ", [_joint_row(joint) for joint in spec.joints]),
        sliding=any(joint.kind == "prismatic" for joint in spec.joints),
        net=design.net,
        group=design.encoding == "group",
        input="dense" if design.input == "dense-3n" else "motor" if spec.inputs else "derived",
        friction_axes=_FRICTION_AXES[design.dissipation],
        depth=spec.options.depth,
        width=_units(spec),
        grid=_GRID,
        friction_hidden=_FRICTION_HIDDEN,
        friction_start=_FRICTION_START,
        slow=_SLOW,
        slowest=_SLOWEST,
        **_waves(spec),
        place_share=_PLACE_SHARE,
        uses_network=bool(spec.outputs or spec.potential),
        **_mass(spec),
        **_potential(spec),
    )


def _closed_form(spec: ModelSpec) -> str:
    mean = _mean_mass(spec)
    joints = [
        _call(
            "Joint",
            name=joint.identifier,
            revolute=joint.kind == "revolute",
            speed=joint.speed,
            friction=joint.friction,
            # one that nothing is known of still has somewhere to start
            rotor=joint.rotor or float(f"{_LEAST_ROTOR * mean[index][index]:.3g}"),
            actuated=joint.actuated,
        )
        for index, joint in enumerate(spec.joints)
    ]
    rows = [
        _call(
            "Body",
            parent=body.parent,
            joint=body.joint,
            revolute=body.kind == "revolute",
            ratio=body.ratio,
            offset=body.offset,
            rotation=body.rotation,
            position=body.position,
            reference=body.reference,
        )
        for body in spec.bodies
    ]
    return render(
        "closed_form.py.jinja",
        **_common(spec),
        joints=_table("JOINTS = ", joints),
        bodies=_table("BODIES = ", rows),
        gravity=_literal(spec.gravity),
    )


def _common(spec: ModelSpec) -> dict[str, object]:
    """What both templates show: the docstring, and G."""
    n = len(spec.joints)
    inputs = [_call("Input", **dict(zip(_INPUT, each, strict=True))) for each in spec.inputs]
    return {
        "title": f"Port-Hamiltonian model of an arm with {n} joint{'s' * (n > 1)}, written by `spelgen build`.",
        "class_summary": f"The arm's dynamics: {_class_summary(spec)}.",
        "summary": _summary(spec),
        "picture": _picture(spec),
        "joint_table": _joint_table(spec),
        "record": _record(spec),
        "n": n,
        "inputs": inputs and _table("INPUTS = ", inputs),
        "gains": any(trained for *_, trained in spec.inputs),
    }


def _mass(spec: ModelSpec) -> dict[str, object]:
    """What the template shows of M."""
    if spec.design.mass == "dense-3n":
        return {
            "mass": "dense",
            "mean_mass": _table("MEAN_MASS = ", [_literal(row) for row in _mean_mass(spec)]),
        }
    constants = [_call("Constant", start=c.start, scale=c.scale, entries=c.basis) for c in spec.constants]
    outputs = [
        _call(
            "Output",
            joints=output.joints,
            mean=output.center,
            scale=output.scale,
            **({} if output.level is None else {"level": output.level, "terms": output.terms}),
            entries=output.basis,
        )
        for output in spec.outputs
    ]
    return {
        "mass": "derived" if outputs else "constant",
        "constants": _table("CONSTANTS: tuple[Constant, ...] = ", constants),
        "outputs": outputs and _table("OUTPUTS = ", outputs),
        "mass_hidden": _table("MASS_HIDDEN = ", [_literal(row) for row in _hidden(spec)]),
        "guard": spec.guard,
    }


def _mean_mass(spec: ModelSpec) -> tuple[tuple[float, ...], ...]:
    """The lower triangle of the nominal mean of M, row by row."""
    terms = [(c.start, c.basis) for c in spec.constants] + [(o.center, o.basis) for o in spec.outputs]
    mean: defaultdict[tuple[int, int], float] = defaultdict(float)
    for size, basis in terms:
        for row, column, value in basis:
            mean[row, column] += size * value
    rows = range(len(spec.joints))
    return tuple(tuple(float(f"{mean[row, column]:.6g}") for column in range(row + 1)) for row in rows)


def _potential(spec: ModelSpec) -> dict[str, object]:
    """What the template shows of V."""
    return {
        "potential_joints": _literal(spec.potential) if spec.potential else "",
        "potential_width": max(_LEAST_UNITS, round(_POTENTIAL_SHARE * _units(spec))),
        "potential_scale": spec.potential_scale,
        "potential_terms": spec.potential_terms and _literal(spec.potential_terms),
    }


def _waves(spec: ModelSpec) -> dict[str, object]:
    """What the template shows of the waves that M and V are made of."""
    powers = any(any(powers) for _, powers in spec.waves)
    rows = [
        _call("Wave", turns=turns, **({"powers": powers_} if powers else {})) for turns, powers_ in spec.waves
    ]
    return {
        "waves": rows and _table("WAVES = ", rows),
        "wave_powers": powers,
        "mass_waves": any(output.level is not None for output in spec.outputs),
        "network_share": _NETWORK_SHARE,
    }


def _units(spec: ModelSpec) -> int:
    """Units in a hidden layer; those of a Kolmogorov-Arnold network have a grid of numbers on every edge."""
    width = spec.options.width
    return width if spec.design.net == "mlp" else max(_LEAST_UNITS, round(_KAN_SHARE * width))


def _joint_row(joint: JointSpec) -> str:
    return _call(
        "Joint",
        name=joint.identifier,
        revolute=joint.kind == "revolute",
        center=joint.center,
        reach=joint.reach,
        speed=joint.speed,
        friction=joint.friction,
        rotor=joint.rotor,
        mass_share=joint.mass_share,
        potential_share=joint.potential_share,
        actuated=joint.actuated,
    )


def _table(start: str, rows: list[str]) -> str:
    """A tuple with a row a line, or on the line that begins with ``start`` where it fits."""
    flat = f"({', '.join(rows)}{',' * (len(rows) == 1)})"
    if len(start) + len(flat) <= _WIDTH and "\n" not in flat:
        return flat
    return "(\n" + "".join(f"    {row},\n" for row in rows) + ")"


def _call(callee: str, **arguments: object) -> str:
    """A call with its keywords, as a row of a table: on one line, or on one line an argument."""
    parts = [f"{key}={_literal(value, indent=8)}" for key, value in arguments.items()]
    flat = f"{callee}({', '.join(parts)})"
    if len(flat) < _WIDTH - 4 and "\n" not in flat:
        return flat
    return f"{callee}(\n" + "".join(f"        {part},\n" for part in parts) + "    )"


def _literal(value: object, indent: int = 0) -> str:
    """``value`` as source text; a tuple too long for a line has an item a line."""
    if isinstance(value, str):
        return json.dumps(value)
    if not isinstance(value, tuple):
        return repr(value)
    parts = [_literal(item, indent + 4) for item in value]
    flat = f"({parts[0]},)" if len(parts) == 1 else f"({', '.join(parts)})"
    if indent + len(flat) < _WIDTH - 12:
        return flat
    inner = " " * (indent + 4)
    return "(\n" + "".join(f"{inner}{part},\n" for part in parts) + " " * indent + ")"


def _hidden(spec: ModelSpec) -> tuple[tuple[tuple[int, ...], int], ...]:
    """How many units of a hidden layer read which joints, in proportion to the outputs that do."""
    least = _LEAST_UNITS if spec.design.net == "mlp" else _LEAST_KAN_UNITS
    shares = Counter(output.joints for output in spec.outputs)
    joints = sorted(shares, key=lambda each: (len(each), each))
    ideal = [_units(spec) * shares[each] / len(spec.outputs) for each in joints]
    units = [max(least, round(size)) for size in ideal]
    # rounding may have taken or left a unit or two: those who gained most give, who lost most take
    while sum(units) > _units(spec) and max(units) > least:
        units[max((k for k, u in enumerate(units) if u > least), key=lambda k: units[k] - ideal[k])] -= 1
    while units and sum(units) < _units(spec):
        units[max(range(len(units)), key=lambda k: ideal[k] - units[k])] += 1
    return tuple(zip(joints, units, strict=True))


def _class_summary(spec: ModelSpec) -> str:
    bodies = len(spec.bodies)
    if bodies:
        return f"{bodies} rigid bod{'ies' if bodies > 1 else 'y'} with trained inertial parameters"
    return _count(spec)


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


def _summary(spec: ModelSpec) -> str:
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
    parts = ["M"] * any(x.level is not None for x in spec.outputs) + ["V"] * bool(spec.potential_terms)
    sums = (
        f"\n{' and '.join(parts)}: sums of waves with trained factors, and a part for a network."
        if parts
        else ""
    )
    return f"{_count(spec)[0].upper()}{_count(spec)[1:]}.\n{potential}{sums}\n{start}"


def _picture(spec: ModelSpec) -> str:
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


def _joint_table(spec: ModelSpec) -> str:
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


def _record(spec: ModelSpec) -> str:
    record = {
        "robot": spec.robot,
        "urdf": spec.urdf,
        "urdf_sha256": spec.urdf_sha256,
        "spec_sha256": spec.sha256,
    }
    lines = [f"    {key}: {json.dumps(value)}" for key, value in record.items()]
    lines += [f"    option {key}: {json.dumps(value)}" for key, value in sorted(asdict(spec.options).items())]
    return "Record, by which `spelgen check` tells whether this module is up to date:\n\n" + "\n".join(lines)
