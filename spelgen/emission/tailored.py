"""ModelSpec -> the tailored part of a module: how its model is put together, and where M's functions stand."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from itertools import groupby
from textwrap import wrap

from spelgen.design import BRISTLE_REACH
from spelgen.emission.source import WIDTH, Call, Code, assignment, call, laid_out
from spelgen.labels import entry_name, joint_ranges
from spelgen.spec import ModelSpec

_LEAST_UNITS = 4
_LEAST_KAN_UNITS = 2
_KAN_FRACTION = 0.25
_POTENTIAL_FRACTION = 0.5
_POSITION_SENSITIVITY = 0.1
_LEAST_ARMATURE = 0.01
_FRICTION_AXES = {"dense-n": 1, "dense-3n": 3}
_UNPACKED = 10  # names on a line
_SEED = Code("generator")
_INDENT = 8


def base(spec: ModelSpec) -> str:
    """The class of the runtime that the model is."""
    if not spec.bodies:
        return "NetworkDynamics"
    return "RigidBodyDynamics" if spec.design.net == "none" else "ResidualDynamics"


def setup(spec: ModelSpec) -> str:
    """The statements of the model's ``__init__`` that make its parts, and itself of them."""
    lines = [assignment("joints", _joints(spec), _INDENT)]
    lines += _rigid_bodies(spec) if spec.bodies else _networks(spec)
    return "\n".join(lines)


def mass_entries(spec: ModelSpec) -> str:
    """The statements that give M from its functions f and constants c; empty where M is not made of them."""
    if spec.design.mass != "derived" and (not spec.bodies or spec.design.net == "none"):
        return ""
    cells: defaultdict[tuple[int, int], list[tuple[float, str]]] = defaultdict(list)
    functions, constants = [each.basis for each in spec.outputs], [each.basis for each in spec.constants]
    for letter, bases in (("f", functions), ("c", constants)):
        for number, basis in enumerate(bases, start=1):
            for row, column, factor in basis:
                cells[row, column].append((factor, f"{letter}{number}"))
    lines = _told(spec) + _unpacked("f", len(spec.outputs)) + _unpacked("c", len(spec.constants))
    rows = []
    for row in range(len(spec.joints)):
        names = []
        for column in range(row + 1):
            text = _sum(cells[row, column])
            if " " in text or text.startswith("-"):
                name = entry_name(row, column).lower().replace(",", "_")
                lines.append(f"{name} = {text}")
                text = name
            names.append(text)
        rows.append(Code(f"[{', '.join(names)}]"))
    whole = laid_out("return ", Call("symmetric", tuple((None, row) for row in rows)), _INDENT)
    return "\n".join(" " * _INDENT + line for line in lines) + "\n" + " " * _INDENT + whole


def names(target: str, values: Iterable[str]) -> str:
    """A class attribute of the model that holds these names."""
    return assignment(target, tuple(values), 4)


def units(spec: ModelSpec) -> int:
    """Units in a hidden layer; those of a Kolmogorov-Arnold network have a grid of numbers on every edge."""
    width = spec.options.width
    return width if spec.design.net == "mlp" else max(_LEAST_UNITS, round(_KAN_FRACTION * width))


def _told(spec: ModelSpec) -> list[str]:
    """Comments that say which joints the functions read."""
    told = ", ".join(
        f"f{number}(q{joint_ranges(output.joints)})" for number, output in enumerate(spec.outputs, start=1)
    )
    return [f"# {line}" for line in wrap(told, WIDTH - _INDENT - 2, break_on_hyphens=False)]


def _unpacked(letter: str, count: int) -> list[str]:
    names = [f"{letter}{number}" for number in range(1, count + 1)]
    if count <= _UNPACKED:
        return (
            [f"{', '.join(names)} = {letter}" if count > 1 else f"({names[0]},) = {letter}"] if names else []
        )
    starts = range(0, count, _UNPACKED)
    return [
        f"{', '.join(part)}{',' * (len(part) == 1)} = {letter}[{start}:{start + len(part)}]"
        for start in starts
        for part in [names[start : start + _UNPACKED]]
    ]


def _sum(terms: Iterable[tuple[float, str]]) -> str:
    """A linear combination as an expression, what is added before what is subtracted; ``0`` for none."""
    text = ""
    for factor, name in sorted(terms, key=lambda term: term[0] < 0):
        size = name if abs(factor) == 1 else f"{_number(abs(factor))} * {name}"
        sign = "-" if factor < 0 else "+"
        text += f" {sign} {size}" if text else f"-{size}" if factor < 0 else size
    return text or "0"


def _number(value: float) -> str:
    return f"{value:g}" if float(f"{value:g}") == value else repr(value)


def _joints(spec: ModelSpec) -> Call:
    mean = mean_mass(spec) if spec.bodies else ()
    armature = tuple(
        # one that nothing is known of still has somewhere to start
        joint.armature or (float(f"{_LEAST_ARMATURE * mean[k][k]:.3g}") if spec.bodies else 0.0)
        for k, joint in enumerate(spec.joints)
    )
    return call(
        "Joints",
        revolute=tuple(joint.kind == "revolute" for joint in spec.joints),
        center=tuple(joint.center for joint in spec.joints),
        reach=tuple(joint.reach for joint in spec.joints),
        speed=tuple(joint.speed for joint in spec.joints),
        friction=tuple(joint.friction for joint in spec.joints),
        armature=armature,
        gear=tuple(joint.gear for joint in spec.joints),
        actuated=tuple(joint.actuated for joint in spec.joints),
    )


def _rigid_bodies(spec: ModelSpec) -> list[str]:
    bodies = call(
        "Bodies",
        parent=tuple(body.parent for body in spec.bodies),
        joint=tuple(body.joint for body in spec.bodies),
        revolute=tuple(body.kind == "revolute" for body in spec.bodies),
        ratio=tuple(body.ratio for body in spec.bodies),
        offset=tuple(body.offset for body in spec.bodies),
        rotation=tuple(body.rotation for body in spec.bodies),
        position=tuple(body.position for body in spec.bodies),
        mass=tuple(body.reference[0] for body in spec.bodies),
        moment=tuple(body.reference[1:4] for body in spec.bodies),
        inertia=tuple(tuple(body.reference[k] for k in (4, 7, 9)) for body in spec.bodies),
        products=tuple(tuple(body.reference[k] for k in (5, 6, 8)) for body in spec.bodies),
    )
    made: list[tuple[str, object]] = [("bodies", bodies)]
    parts: list[object] = [Code("joints"), Code("bodies"), spec.gravity, _input(spec)]
    if spec.design.net != "none":
        made += _residuals(spec)
        parts += [Code("mass"), Code("potential") if spec.potential else None]
    reach = tuple(BRISTLE_REACH[x.kind] for x in spec.joints)
    remembers = {"reach": reach} if spec.design.memory == "bristles" else {}
    lines = [assignment(name, value, _INDENT) for name, value in made]
    lines.append(_base_setup(call("super().__init__", *parts, **remembers)))
    if spec.servos:
        lines.append(assignment("self.servo", _servo(spec), _INDENT))
    return lines


def _residuals(spec: ModelSpec) -> list[tuple[str, object]]:
    """What stands beside rigid bodies, in the order in which it draws its random weights."""
    made: list[tuple[str, object]] = []
    if spec.outputs or spec.potential:
        made.append(("generator", Code("torch.Generator().manual_seed(seed)")))
    network: object = None
    if spec.outputs:
        made += [
            ("functions", _grouped("functions = ", [each.joints for each in spec.outputs])),
            ("network", _mass_network(spec, Code("functions"))),
        ]
        network = Code("network")
    sizes = len(spec.outputs), len(spec.constants)
    mass = call("ResidualMass", Code("joints"), Code("self.mass_entries"), *sizes, network)
    return [*made, ("mass", mass), *_potential(spec)]


def _grouped(start: str, rows: Sequence[tuple[int, ...]]) -> Code:
    """The tuple of these rows, of which those that are alike stand together; ``start`` precedes it."""
    groups = [(row, len([*alike])) for row, alike in groupby(rows)]
    terms = [f"({row!r},)" + f" * {count}" * (count > 1) for row, count in groups]
    if _INDENT + len(start + " + ".join(terms)) <= WIDTH:
        return Code(" + ".join(terms))
    inner = " " * (_INDENT + 4)
    lines = [inner + terms[0]]
    for term in terms[1:]:
        if len(lines[-1]) + len(term) + 3 > WIDTH:
            lines.append(f"{inner}+ {term}")
        else:
            lines[-1] += f" + {term}"
    return Code("\n".join(["(", *lines, " " * _INDENT + ")  # fmt: skip"]))


def _servo(spec: ModelSpec) -> Call:
    infinite = Code('float("inf")')
    return call(
        "PositionServo",
        kp=tuple(servo.kp for servo in spec.servos),
        kd=tuple(servo.kd for servo in spec.servos),
        limit=tuple(infinite if servo.limit is None else servo.limit for servo in spec.servos),
        known=tuple(servo.known for servo in spec.servos),
    )


def _networks(spec: ModelSpec) -> list[str]:
    """Parts in the order in which they draw their random weights: mass, potential, friction, input."""
    made: list[tuple[str, object]] = [
        ("generator", Code("torch.Generator().manual_seed(seed)")),
        ("encoding", Code("JointEncoding(joints)")),
    ]
    made += [*_mass(spec), *_potential(spec), ("friction", _friction(spec))]
    parts: list[object] = [Code(name) for name in ("encoding", "mass", "potential", "friction")]
    if not spec.potential:
        parts[2] = None
    parts.append(_input(spec))
    lines = [assignment(name, value, _INDENT) for name, value in made]
    return [*lines, _base_setup(call("super().__init__", *parts))]


def _base_setup(value: Call) -> str:
    return " " * _INDENT + laid_out("", value, _INDENT)


def _mass(spec: ModelSpec) -> list[tuple[str, object]]:
    if spec.design.mass == "dense-3n":
        sensitivity = tuple(joint.mass_sensitivity for joint in spec.joints)
        rows = 3 * len(spec.joints)
        outputs = Code(f"[range({len(spec.joints)})] * {rows * (rows + 1) // 2}")
        network = _network(spec, outputs, tuple(range(len(spec.joints))), sensitivity)
        made = call("DenseMass", Code("joints"), mean=mean_mass(spec), network=network)
        return [("mass", made)]
    constants = tuple((each.start, each.scale) for each in spec.constants)
    if not spec.outputs:
        return [("mass", call("ConstantMass", Code("joints"), Code("self.mass_entries"), constants))]
    functions = tuple(
        call("MassFunction", each.joints, mean=each.mean, scale=each.scale) for each in spec.outputs
    )
    parts = [Code(name) for name in ("joints", "self.mass_entries", "functions", "constants", "network")]
    return [
        ("functions", functions),
        ("constants", constants),
        ("network", _mass_network(spec, Code("[function.joints for function in functions]"))),
        ("mass", call("DerivedMass", *parts, spec.margin)),
    ]


def _mass_network(spec: ModelSpec, outputs: Code) -> Call:
    """The network of M's functions, which reads the joints that they depend on."""
    least = _LEAST_UNITS if spec.design.net == "mlp" else _LEAST_KAN_UNITS
    read = tuple(sorted({joint for each in spec.outputs for joint in each.joints}))
    if spec.design.encoding == "lie-group":
        read = tuple(range(len(spec.joints)))
    sensitivity = tuple(joint.mass_sensitivity for joint in spec.joints)
    return _network(spec, outputs, read, sensitivity, least=least)


def _potential(spec: ModelSpec) -> list[tuple[str, object]]:
    if not spec.potential:
        return []
    sensitivity = tuple(joint.potential_sensitivity for joint in spec.joints)
    width = max(_LEAST_UNITS, round(_POTENTIAL_FRACTION * units(spec)))
    network = _network(spec, (spec.potential,), spec.potential, sensitivity, width=width)
    made = call("LearnedPotential", spec.potential_scale, Code("network"))
    return [("network", network), ("potential", made)]


def _network(
    spec: ModelSpec,
    outputs: object,
    read: tuple[int, ...],
    sensitivity: object,
    *,
    axes: int = 0,
    width: int | None = None,
    least: int | None = None,
) -> Call:
    """A network of ``outputs``; ``read``: the joints whose encoding it reads."""
    if spec.design.encoding == "lie-group":
        inputs = call("lie_group_input", Code("joints"), sensitivity)
    else:
        inputs = call("joint_input", Code("joints"), read, sensitivity)
    if axes:
        inputs = call("with_velocities", inputs, Code("joints"), axes)
    size = {"width": width or units(spec), "depth": spec.options.depth} | ({"least": least} if least else {})
    kind = "MaskedMLP" if spec.design.net == "mlp" else "MaskedKAN"
    return call(kind, inputs, call("unit_joints", outputs, **size), _SEED)


def _friction(spec: ModelSpec) -> Call:
    if spec.design.dissipation == "per-joint":
        return call("JointFriction", Code("joints"), Code("encoding"), _SEED)
    n, axes = len(spec.joints), _FRICTION_AXES[spec.design.dissipation]
    everything, rows = tuple(range(n)), axes * n
    outputs = Code(f"[range({n})] * {rows * (rows + 1) // 2}")
    sensitivity = (_POSITION_SENSITIVITY,) * n
    network = _network(spec, outputs, everything, sensitivity, axes=axes)
    return call("DenseFriction", Code("joints"), network, axes=axes)


def _input(spec: ModelSpec) -> Call:
    if spec.design.input == "dense-3n":
        n = len(spec.joints)
        everything = tuple(range(n))
        outputs = Code(f"[range({n})] * {3 * n}")
        network = _network(spec, outputs, everything, (1.0,) * n)
        return call("DenseInput", Code("joints"), network)
    if not spec.inputs:
        speeds = {"motor_speeds": spec.motor_speeds} if spec.motor_speeds else {}
        return call("DirectInput", Code("joints"), **speeds)
    gains = tuple(
        call("MotorGain", joint, motor, value, trained=trained)
        for joint, motor, value, trained in spec.inputs
    )
    return call("MotorInput", Code("joints"), gains)


def mean_mass(spec: ModelSpec) -> tuple[tuple[float, ...], ...]:
    """The lower triangle of the nominal mean of M, row by row."""
    terms = [(c.start, c.basis) for c in spec.constants] + [(o.mean, o.basis) for o in spec.outputs]
    mean: defaultdict[tuple[int, int], float] = defaultdict(float)
    for size, basis in terms:
        for row, column, value in basis:
            mean[row, column] += size * value
    rows = range(len(spec.joints))
    return tuple(tuple(float(f"{mean[row, column]:.6g}") for column in range(row + 1)) for row in rows)
