"""ModelSpec -> the tailored part of a module: how its model is put together, and where M's functions stand."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from textwrap import wrap

from spelgen.design import BRISTLE_REACH
from spelgen.emission.source import WIDTH, Call, Code, assignment, call, laid_out
from spelgen.emission.unit_joints import hidden_units
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
_INDENT = 4


@dataclass(frozen=True)
class _Parts:
    """The statements that make a model's parts, and the parts: the type and the expression of each."""

    statements: list[tuple[str, object]]
    values: list[tuple[str, object]]


def bases(spec: ModelSpec) -> str:
    """Return the classes of the runtime that the model is."""
    if spec.design.input == "dense-3n":
        return "DenseInput"
    dynamics = "NetworkDynamics"
    if spec.bodies:
        dynamics = "RigidBodyDynamics" if spec.design.net == "none" else "ResidualDynamics"
    return f"{dynamics}, MotorInput" if spec.inputs else dynamics


def roles(spec: ModelSpec) -> dict[str, str]:
    """Return the type of each kind of part that the model has, by the name that the runtime has for the kind."""
    prefix = "KAN" if spec.design.net == "kan" else "MLP"
    layers, residuals = f"{prefix}Layers", f"{prefix}Residuals"
    network = {"Network": f"Masked{prefix}", "Layers": layers, "NetworkResiduals": residuals}
    if spec.bodies:
        rigid = {"Pose": "Motion", "Prepared": "RigidPrepared", "MassResiduals": "object"}
        if spec.design.net == "none":
            return rigid
        return network | rigid | {"MassResiduals": "FunctionResiduals | None"}
    mass = ("DerivedMass", f"tuple[{layers}, bool]", f"tuple[{residuals}, Tensor]")
    if spec.design.mass == "dense-3n":
        mass = ("DenseMass", layers, "DenseResiduals")
    elif not spec.outputs:
        mass = ("ConstantMass", "Tensor", "object")
    friction = ("DenseFriction", layers)
    if spec.design.dissipation == "per-joint":
        friction = ("JointFriction", "FrictionLayers")
    pairs = {"Pose": "Tensor", "Prepared": "NetworkPrepared"}
    pairs |= dict(zip(("Mass", "MassPrepared", "MassResiduals"), mass, strict=True))
    return network | pairs | dict(zip(("Friction", "FrictionPrepared"), friction, strict=True))


def parts(spec: ModelSpec) -> tuple[str, str]:
    """Return the types of what the model is made of, and the statements that make and return it."""
    statements: list[tuple[str, object]] = [("joints", _joints(spec))]
    made = _rigid_bodies(spec) if spec.bodies else _networks(spec)
    lines = [assignment(name, value, _INDENT) for name, value in statements + made.statements]
    values = tuple(value for _, value in made.values)
    lines.append(" " * _INDENT + laid_out("return ", values, _INDENT))
    return ", ".join(kind for kind, _ in made.values), "\n".join(lines)


def servo(spec: ModelSpec) -> str:
    """Return the statement that puts position servos before the model's joints; empty without them."""
    return assignment("self.servo", _servo(spec), 2 * _INDENT) if spec.servos else ""


def mass_entries(spec: ModelSpec) -> str:
    """The statements that give M from its functions f and constants c; empty where M is not made of them."""
    if spec.design.mass != "derived" and (not spec.bodies or spec.design.net == "none"):
        return ""
    cells: defaultdict[tuple[int, int], list[tuple[float, str]]] = defaultdict(list)
    functions, constants = [term.basis for term in spec.outputs], [term.basis for term in spec.constants]
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
    statement = laid_out("return ", Call("symmetric", tuple((None, row) for row in rows)), _INDENT)
    return "\n".join(" " * _INDENT + line for line in lines) + "\n" + " " * _INDENT + statement


def names(target: str, values: Iterable[str]) -> str:
    """A class attribute of the model that holds these names."""
    return assignment(target, tuple(values), 4)


def units(spec: ModelSpec) -> int:
    """Units in a hidden layer; those of a Kolmogorov-Arnold network have a grid of numbers on every edge."""
    width = spec.options.width
    return width if spec.design.net == "mlp" else max(_LEAST_UNITS, round(_KAN_FRACTION * width))


def _told(spec: ModelSpec) -> list[str]:
    """Comments that say which joints the functions read."""
    text = ", ".join(
        f"f{number}(q{joint_ranges(output.joints)})" for number, output in enumerate(spec.outputs, start=1)
    )
    return [f"# {line}" for line in wrap(text, WIDTH - _INDENT - 2, break_on_hyphens=False)]


def _unpacked(letter: str, count: int) -> list[str]:
    names = [f"{letter}{number}" for number in range(1, count + 1)]
    if count <= _UNPACKED:
        return (
            [f"{', '.join(names)} = {letter}" if count > 1 else f"({names[0]},) = {letter}"] if names else []
        )
    lines = []
    for start in range(0, count, _UNPACKED):
        chunk = names[start : start + _UNPACKED]
        comma = "," if len(chunk) == 1 else ""
        lines.append(f"{', '.join(chunk)}{comma} = {letter}[{start}:{start + len(chunk)}]")
    return lines


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


def _columns(rows: Sequence[object], *names: str) -> dict[str, object]:
    """Return these attributes of all rows, by name."""
    return {name: tuple(getattr(row, name) for row in rows) for name in names}


def _joints(spec: ModelSpec) -> Call:
    mean = mean_mass(spec) if spec.bodies else ()
    armature = tuple(
        # one that nothing is known of still has somewhere to start
        joint.armature or (float(f"{_LEAST_ARMATURE * mean[k][k]:.3g}") if spec.bodies else 0.0)
        for k, joint in enumerate(spec.joints)
    )
    optional: dict[str, object] = {"gains": spec.inputs} if spec.inputs else {}
    if spec.bodies and spec.design.net != "none":
        optional["gear"] = tuple(joint.gear for joint in spec.joints)
    return call(
        "Joints",
        revolute=tuple(joint.kind == "revolute" for joint in spec.joints),
        **_columns(spec.joints, "center", "reach", "speed", "friction"),
        armature=armature,
        actuated=tuple(joint.actuated for joint in spec.joints),
        **optional,
    )


def _rigid_bodies(spec: ModelSpec) -> _Parts:
    bodies = call(
        "Bodies",
        **_columns(spec.bodies, "parent", "joint"),
        revolute=tuple(body.kind == "revolute" for body in spec.bodies),
        **_columns(spec.bodies, "ratio", "offset", "rotation", "position"),
        inertia=tuple(body.reference for body in spec.bodies),
    )
    reach = tuple(BRISTLE_REACH[x.kind] for x in spec.joints) if spec.design.memory == "bristles" else ()
    made = _Parts(
        [("bodies", bodies)],
        [
            ("Joints", Code("joints")),
            ("Bodies", Code("bodies")),
            ("Row", spec.gravity),
            ("Rows", reach),
            ("Rows", spec.motor_speeds),
        ],
    )
    if spec.design.net != "none":
        made.statements.extend(_residuals(spec))
        made.values.extend([("ResidualMass", Code("mass")), *_potential_values(spec)])
    return made


def _residuals(spec: ModelSpec) -> list[tuple[str, object]]:
    """What stands beside rigid bodies, in the order in which it draws its random weights."""
    statements: list[tuple[str, object]] = []
    if spec.outputs or spec.potential:
        statements.append(("generator", Code("torch.Generator().manual_seed(seed)")))
    network: object = None
    if spec.outputs:
        statements += _mass_network(spec)
        network = Code("network")
    sizes = len(spec.outputs), len(spec.constants)
    mass = call("ResidualMass", Code("joints"), Code("mass_entries"), *sizes, network)
    return [*statements, ("mass", mass), *_potential(spec)]


def _potential_values(spec: ModelSpec) -> list[tuple[str, object]]:
    """The network of the potential energy, and the unit of it."""
    if not spec.potential:
        return [("None", None), ("float", 1.0)]
    return [("Network", Code("potential")), ("float", spec.potential_scale)]


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
        **_columns(spec.servos, "kp", "kd"),
        limit=tuple(infinite if servo.limit is None else servo.limit for servo in spec.servos),
        **_columns(spec.servos, "known"),
    )


def _networks(spec: ModelSpec) -> _Parts:
    """Parts in the order in which they draw their random weights: mass, potential, friction, input."""
    statements: list[tuple[str, object]] = [("generator", Code("torch.Generator().manual_seed(seed)"))]
    statements += [*_mass(spec), *_potential(spec), *_friction(spec)]
    values = [("Joints", Code("joints")), ("Mass", Code("mass")), *_potential_values(spec)]
    values.append(("Friction", Code("friction")))
    if spec.design.input == "dense-3n":
        n = len(spec.joints)
        everything = tuple(range(n))
        statements += _network(spec, "input", (everything,) * (3 * n), everything, (1.0,) * n)
        values.append(("Network", Code("network")))
    return _Parts(statements, values)


def _mass(spec: ModelSpec) -> list[tuple[str, object]]:
    if spec.design.mass == "dense-3n":
        sensitivity = tuple(joint.mass_sensitivity for joint in spec.joints)
        rows = 3 * len(spec.joints)
        everything = tuple(range(len(spec.joints)))
        network = _network(spec, "mass", (everything,) * (rows * (rows + 1) // 2), everything, sensitivity)
        mass = call("DenseMass", Code("joints"), mean=mean_mass(spec), network=Code("network"))
        return [*network, ("mass", mass)]
    constants = tuple((term.start, term.scale) for term in spec.constants)
    if not spec.outputs:
        return [("mass", call("ConstantMass", Code("joints"), Code("mass_entries"), constants))]
    mass = call(
        "DerivedMass",
        Code("joints"),
        Code("mass_entries"),
        functions=tuple((output.mean, output.scale) for output in spec.outputs),
        constants=constants,
        network=Code("network"),
        margin=spec.margin,
    )
    return [*_mass_network(spec), ("mass", mass)]


def _mass_network(spec: ModelSpec) -> list[tuple[str, object]]:
    """The network of M's functions, which reads the joints that they depend on."""
    fewest = _LEAST_KAN_UNITS if spec.design.net == "kan" else _LEAST_UNITS
    outputs = tuple(output.joints for output in spec.outputs)
    read = tuple(sorted({joint for joints in outputs for joint in joints}))
    if spec.design.encoding == "lie-group":
        read = tuple(range(len(spec.joints)))
    sensitivity = tuple(joint.mass_sensitivity for joint in spec.joints)
    return _network(spec, "mass", outputs, read, sensitivity, fewest=fewest)


def _potential(spec: ModelSpec) -> list[tuple[str, object]]:
    if not spec.potential:
        return []
    sensitivity = tuple(joint.potential_sensitivity for joint in spec.joints)
    width = max(_LEAST_UNITS, round(_POTENTIAL_FRACTION * units(spec)))
    return _network(
        spec, "potential", (spec.potential,), spec.potential, sensitivity, width=width, name="potential"
    )


def _network(
    spec: ModelSpec,
    quantity: str,
    outputs: tuple[tuple[int, ...], ...],
    read: tuple[int, ...],
    sensitivity: object,
    *,
    axes: int = 0,
    width: int | None = None,
    fewest: int = 1,
    name: str = "network",
) -> list[tuple[str, object]]:
    """Return the statements that make a network of ``outputs`` for a quantity; ``read``: the joints that it reads."""
    if spec.design.encoding == "lie-group":
        inputs = call("lie_group_input", Code("joints"), sensitivity)
    else:
        inputs = call("joint_input", Code("joints"), read, sensitivity)
    if axes:
        inputs = call("with_velocities", inputs, Code("joints"), axes)
    hidden = hidden_units(outputs, width or units(spec), fewest)
    layers = ", ".join([*([f"{quantity}_hidden"] * spec.options.depth), f"{quantity}_outputs"])
    return [
        (f"{quantity}_outputs", _grouped(f"{quantity}_outputs = ", outputs)),
        (f"{quantity}_hidden", _grouped(f"{quantity}_hidden = ", hidden)),
        (name, call("Network", inputs, Code(f"({layers})"), _SEED)),
    ]


def _friction(spec: ModelSpec) -> list[tuple[str, object]]:
    if spec.design.dissipation == "per-joint":
        return [("friction", call("JointFriction", Code("joints"), _SEED))]
    n, axes = len(spec.joints), _FRICTION_AXES[spec.design.dissipation]
    everything, rows = tuple(range(n)), axes * n
    outputs = (everything,) * (rows * (rows + 1) // 2)
    network = _network(spec, "friction", outputs, everything, (_POSITION_SENSITIVITY,) * n, axes=axes)
    friction = call("DenseFriction", Code("joints"), Code("network"), axes=axes)
    return [*network, ("friction", friction)]


def mean_mass(spec: ModelSpec) -> tuple[tuple[float, ...], ...]:
    """The lower triangle of the nominal mean of M, row by row."""
    terms = [(c.start, c.basis) for c in spec.constants] + [(o.mean, o.basis) for o in spec.outputs]
    mean: defaultdict[tuple[int, int], float] = defaultdict(float)
    for size, basis in terms:
        for row, column, value in basis:
            mean[row, column] += size * value
    rows = range(len(spec.joints))
    return tuple(tuple(float(f"{mean[row, column]:.6g}") for column in range(row + 1)) for row in rows)
