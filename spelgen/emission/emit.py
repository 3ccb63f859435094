"""ModelSpec -> the source text of the emitted module. Pure: the same spec gives the same bytes.

Text from a URDF reaches the module as identifiers and as JSON strings inside its raw docstring, never as
code.
"""

from __future__ import annotations

from collections import Counter, defaultdict

from spelgen.emission import docstring
from spelgen.emission.source import call, literal, table
from spelgen.spec import JointSpec, ModelSpec
from spelgen.templates import render

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
        joints=table("JOINTS = ", [_joint_row(joint) for joint in spec.joints]),
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
        call(
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
        call(
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
        joints=table("JOINTS = ", joints),
        bodies=table("BODIES = ", rows),
        gravity=literal(spec.gravity),
    )


def _common(spec: ModelSpec) -> dict[str, object]:
    """What both templates show: the docstring, and G."""
    inputs = [call("Input", **dict(zip(_INPUT, each, strict=True))) for each in spec.inputs]
    return {
        "title": docstring.title(spec),
        "class_summary": docstring.class_summary(spec),
        "summary": docstring.summary(spec),
        "picture": docstring.picture(spec),
        "joint_table": docstring.joint_table(spec),
        "record": docstring.record(spec),
        "n": len(spec.joints),
        "inputs": inputs and table("INPUTS = ", inputs),
        "gains": any(trained for *_, trained in spec.inputs),
    }


def _mass(spec: ModelSpec) -> dict[str, object]:
    """What the template shows of M."""
    if spec.design.mass == "dense-3n":
        return {
            "mass": "dense",
            "mean_mass": table("MEAN_MASS = ", [literal(row) for row in _mean_mass(spec)]),
        }
    constants = [call("Constant", start=c.start, scale=c.scale, entries=c.basis) for c in spec.constants]
    outputs = [
        call(
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
        "constants": table("CONSTANTS: tuple[Constant, ...] = ", constants),
        "outputs": outputs and table("OUTPUTS = ", outputs),
        "mass_hidden": table("MASS_HIDDEN = ", [literal(row) for row in _hidden(spec)]),
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
        "potential_joints": literal(spec.potential) if spec.potential else "",
        "potential_width": max(_LEAST_UNITS, round(_POTENTIAL_SHARE * _units(spec))),
        "potential_scale": spec.potential_scale,
        "potential_terms": spec.potential_terms and literal(spec.potential_terms),
    }


def _waves(spec: ModelSpec) -> dict[str, object]:
    """What the template shows of the waves that M and V are made of."""
    powers = any(any(powers) for _, powers in spec.waves)
    rows = [
        call("Wave", turns=turns, **({"powers": powers_} if powers else {})) for turns, powers_ in spec.waves
    ]
    return {
        "waves": rows and table("WAVES = ", rows),
        "wave_powers": powers,
        "mass_waves": any(output.level is not None for output in spec.outputs),
        "network_share": _NETWORK_SHARE,
    }


def _units(spec: ModelSpec) -> int:
    """Units in a hidden layer; those of a Kolmogorov-Arnold network have a grid of numbers on every edge."""
    width = spec.options.width
    return width if spec.design.net == "mlp" else max(_LEAST_UNITS, round(_KAN_SHARE * width))


def _joint_row(joint: JointSpec) -> str:
    return call(
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
