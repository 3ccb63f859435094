"""ModelSpec -> the tailored part of a module: how its model is put together, and where M's functions stand."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from itertools import groupby
from operator import attrgetter
from textwrap import fill, indent

import numpy as np

from spelgen.design import BRISTLE_REACH, SERVO_STRIBECK_ROUNDING
from spelgen.emission.source import WIDTH, Call, Code, assignment, call, laid_out
from spelgen.emission.tuning import TUNING
from spelgen.emission.unit_joints import hidden_units
from spelgen.labels import entry_name, joint_ranges
from spelgen.spec import BodySpec, ConstantSpec, JointSpec, ModelSpec, OutputSpec

_FRICTION_AXES = {"dense-n": 1, "dense-3n": 3}
_UNPACKED = 10  # names on a line
_GENERATOR = Code("torch.Generator().manual_seed(seed)")
_INDENT = 4
_DEPTH = 2  # hidden layers of a network that names no number of them


class _Body:
    """The statements of ``make_parts``, in their order, and what it returns, with the type of each."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.types: list[str] = []
        self.values: list[object] = []

    def let(self, name: str, value: object) -> Code:
        """Add an assignment; return the name."""
        self.lines.append(assignment(name, value, _INDENT))
        return Code(name)

    def give(self, kind: str, value: object) -> None:
        """Return this value, too."""
        self.types.append(kind)
        self.values.append(value)


def bases(spec: ModelSpec) -> str:
    """Return the classes of the runtime that the model is."""
    if spec.design.input == "dense-3n":
        return "DenseInput"
    dynamics = "NetworkDynamics"
    if spec.bodies:
        dynamics = "RigidBodyDynamics" if spec.design.net == "none" else "ResidualDynamics"
        if spec.motor_speeds:
            dynamics = "CoupledDrives" if spec.design.net == "none" else "ResidualDynamics, CoupledDrives"
    return f"{dynamics}, MotorInput" if spec.inputs else dynamics


def kinds(spec: ModelSpec) -> dict[str, str]:
    """Return the runtime's class for each kind of part that the model has."""
    network = {"Network": "MaskedKAN" if spec.design.net == "kan" else "MaskedMLP"}
    if spec.bodies:
        if spec.design.net == "none":
            network = {}
        return network | {"Pose": "Motion", "Prepared": "RigidPrepared"}
    mass = "DerivedMass" if spec.outputs else "ConstantMass"
    if spec.design.mass == "dense-3n":
        mass = "DenseMass"
    friction = "JointFriction" if spec.design.dissipation == "per-joint" else "DenseFriction"
    return network | {
        "Pose": "NetworkPose",
        "Mass": mass,
        "Friction": friction,
    }


def parts(spec: ModelSpec) -> tuple[str, str]:
    """Return the types of what the model is made of, and the statements that make and return it."""
    body = _Body()
    if spec.bodies:
        _rigid_bodies(body, spec)
    else:
        body.give("Joints", body.let("joints", _joints(spec)))
        _networks(body, spec)
    body.lines.append(" " * _INDENT + laid_out("return ", tuple(body.values), _INDENT))
    return ", ".join(body.types), "\n".join(body.lines)


def servo(spec: ModelSpec) -> str:
    """Return the statements that put position servos before the model's joints; empty without them."""
    if not spec.servos:
        return ""
    limits: list[object] = []
    for joint in spec.servos:
        limits.append(Code('float("inf")') if joint.limit is None else joint.limit)
    gains = _columns(spec.servos, "kp", "kd")
    known = _columns(spec.servos, "known")
    servos = assignment(
        "self.servo", call("PositionServo", **gains, limit=tuple(limits), **known), 2 * _INDENT
    )
    rounding = f"self.friction.stribeck_rounding.fill_({SERVO_STRIBECK_ROUNDING})"
    return f"{servos}\n{' ' * 2 * _INDENT}{rounding}"


def mass_entries(spec: ModelSpec) -> str:
    """The statements that give M from its functions f and constants c; empty where M is not made of them."""
    if spec.design.mass != "derived" and (not spec.bodies or spec.design.net == "none"):
        return ""
    cells: defaultdict[tuple[int, int], list[tuple[float, str]]] = defaultdict(list)
    functions: Sequence[OutputSpec | ConstantSpec] = spec.outputs
    for letter, terms in (("f", functions), ("c", spec.constants)):
        for number, term in enumerate(terms, start=1):
            for row, column, factor in term.basis:
                cells[row, column].append((factor, f"{letter}{number}"))
    lines = _function_comments(spec) + _unpacked("f", len(spec.outputs)) + _unpacked("c", len(spec.constants))
    rows: list[tuple[None, object]] = []
    for row in range(len(spec.joints)):
        names = []
        for column in range(row + 1):
            text = _sum(cells[row, column])
            if " " in text or text.startswith("-"):
                name = entry_name(row, column).lower().replace(",", "_")
                lines.append(f"{name} = {text}")
                text = name
            names.append(text)
        rows.append((None, Code(f"[{', '.join(names)}]")))
    statement = laid_out("return ", Call("symmetric", tuple(rows)), _INDENT)
    return indent("\n".join(lines) + "\n", " " * _INDENT) + " " * _INDENT + statement


def attributes(spec: ModelSpec) -> list[str]:
    """Return the class attributes of the model."""
    columns = _columns(spec.joints, "identifier", "kind")
    lines = [f"    n = {len(spec.joints)}"]
    lines.append(assignment("joint_names", columns["identifier"], _INDENT))
    lines.append(assignment("joint_types", columns["kind"], _INDENT))
    if spec.inputs:
        lines.append(assignment("motor_gains", spec.inputs, _INDENT))
    return lines


def units(spec: ModelSpec) -> int:
    """Units in a hidden layer; those of a Kolmogorov-Arnold network have a grid of numbers on every edge."""
    width = spec.options.width
    return width if spec.design.net == "mlp" else max(TUNING.least_units, round(TUNING.kan_fraction * width))


def _function_comments(spec: ModelSpec) -> list[str]:
    """Comments that say which joints the functions read."""
    functions = []
    for number, output in enumerate(spec.outputs, start=1):
        functions.append(f"f{number}(q{joint_ranges(output.joints)})")
    comment = fill(
        ", ".join(functions),
        WIDTH - _INDENT,
        initial_indent="# ",
        subsequent_indent="# ",
        break_on_hyphens=False,
    )
    return comment.splitlines()


def _unpacked(letter: str, count: int) -> list[str]:
    """Assignments of f1, f2 ... to the items of f, so many on a line."""
    lines = []
    for start in range(0, count, _UNPACKED):
        end = min(start + _UNPACKED, count)
        target = ", ".join(f"{letter}{number}" for number in range(start + 1, end + 1))
        if count == 1:
            target = f"({target},)"
        elif end - start == 1:
            target += ","
        source = letter
        if count > _UNPACKED:
            source = f"{letter}[{start}:{end}]"
        lines.append(f"{target} = {source}")
    return lines


def _sum(terms: Iterable[tuple[float, str]]) -> str:
    """A linear combination as an expression, what is added before what is subtracted; ``0`` for none."""
    text = ""
    for factor, name in sorted(terms, key=lambda term: term[0] < 0):
        size = name
        if abs(factor) != 1:
            size = f"{_number(abs(factor))} * {name}"
        if factor < 0:
            text += f" - {size}"
        else:
            text += f" + {size}"
    if text.startswith(" - "):
        return f"-{text[3:]}"
    return text[3:] or "0"


def _number(value: float) -> str:
    """The shortest text of a number."""
    short = f"{value:g}"
    return short if float(short) == value else repr(value)


def _columns(rows: Sequence[object], *names: str) -> dict[str, object]:
    """Return these attributes of all rows, by name."""
    columns: dict[str, object] = {}
    for name in names:
        columns[name] = tuple(map(attrgetter(name), rows))
    return columns


def _joints(spec: ModelSpec) -> Call:
    """The call that makes the table of the joints."""
    return call(
        "Joints",
        revolute=_revolute(spec.joints),
        **_columns(spec.joints, "center", "reach", "speed", "friction"),
        armature=_armature(spec),
    )


def _armature(spec: ModelSpec) -> object:
    """What the drives add to M: one beside bodies that nothing is known of still has somewhere to start."""
    mean, armature = mean_mass(spec), []
    for k, joint in enumerate(spec.joints):
        least = float(f"{TUNING.least_armature * mean[k][k]:.3g}") if spec.bodies else 0.0
        armature.append(joint.armature or least)
    return tuple(armature)


def _revolute(parts: Sequence[JointSpec | BodySpec]) -> tuple[bool, ...]:
    """Which joints or bodies turn."""
    return tuple(part.kind == "revolute" for part in parts)


def _rigid_bodies(body: _Body, spec: ModelSpec) -> None:
    """Add what stands beside bodies, if anything does, and the bodies."""
    usual, armature = _columns(spec.joints, "friction", "speed"), _armature(spec)
    if spec.design.net != "none":
        body.let("joints", _joints(spec))
        usual = {"friction": Code("joints.friction"), "speed": Code("joints.speed")}
        armature = Code("joints.armature")
        _residuals(body, spec)
    chain = call(
        "BodyChain",
        n=len(spec.joints),
        gravity=spec.gravity,
        **_columns(spec.bodies, "parent", "joint"),
        revolute=_revolute(spec.bodies),
        **_columns(spec.bodies, "ratio", "offset", "placement"),
    )
    if spec.motor_speeds:
        body.give("Rows", spec.motor_speeds)
    inertias = tuple(map(attrgetter("pseudo_inertia"), spec.bodies))
    body.give("BodyChain", body.let("chain", chain))
    body.give("InertialParameters", body.let("bodies", call("InertialParameters", *inertias)))
    body.give("FrictionLaws", body.let("friction", _friction_laws(spec, usual)))
    body.give("Row", armature)


def _friction_laws(spec: ModelSpec, usual: dict[str, object]) -> Call:
    """The call that makes friction's laws, of joints with these usual sizes of friction and velocities."""
    if spec.design.memory == "none":
        return call("SlidingFriction", **usual)
    reach: list[object] = []
    for joint in spec.joints:
        reach.append(BRISTLE_REACH[joint.kind])
    return call("FrictionLaws", **usual, reach=tuple(reach))


def _residuals(body: _Body, spec: ModelSpec) -> None:
    """Add what stands beside rigid bodies, in the order in which it draws its random weights."""
    if spec.outputs or spec.potential:
        body.let("generator", _GENERATOR)
    network = potential = None
    if spec.outputs:
        network = _mass_network(body, spec)
    if spec.potential:
        potential = _potential(body, spec)
    residuals = call(
        "ResidualTerms",
        Code("joints"),
        _columns(spec.joints, "gear")["gear"],
        Code("mass_entries"),
        functions=len(spec.outputs),
        constants=len(spec.constants),
        network=network,
        potential=potential,
        scale=spec.potential_scale,
    )
    body.give("ResidualTerms", body.let("residuals", residuals))


def _groups(outputs: Sequence[tuple[int, ...]]) -> tuple[tuple[tuple[int, ...], int], ...]:
    """Return which joints so many outputs in a row read."""
    return tuple((joints, len([*alike])) for joints, alike in groupby(outputs))


def _networks(body: _Body, spec: ModelSpec) -> None:
    """Add parts in the order in which they draw their random weights: mass, potential, friction, input."""
    body.let("generator", _GENERATOR)
    body.give("Mass", _mass(body, spec))
    if spec.potential:
        body.give("Network", _potential(body, spec))
        body.give("float", spec.potential_scale)
    else:
        # one output that reads no joint
        inputs = ((1.0,) * len(spec.joints),) * 2
        network = call("Network", Code("generator"), inputs, hidden=(), outputs=(((), 1),), depth=0)
        body.give("Network", body.let("potential", network))
        body.give("float", 1.0)
    body.give("Friction", _friction(body, spec))
    if spec.design.input == "dense-3n":
        n = len(spec.joints)
        body.give("Network", _network(body, spec, (_all(spec),) * (3 * n), (1.0,) * n))


def _all(spec: ModelSpec) -> tuple[int, ...]:
    return tuple(range(len(spec.joints)))


def _mass(body: _Body, spec: ModelSpec) -> Code:
    if spec.design.mass == "dense-3n":
        rows = 3 * len(spec.joints)
        outputs = (_all(spec),) * (rows * (rows + 1) // 2)
        sensitivity = _columns(spec.joints, "mass_sensitivity")["mass_sensitivity"]
        network = _network(body, spec, outputs, sensitivity)
        return body.let("mass", call("Mass", Code("joints"), mean=mean_mass(spec), network=network))
    constants = tuple(map(attrgetter("start", "scale"), spec.constants))
    if not spec.outputs:
        return body.let("mass", call("Mass", Code("joints"), Code("mass_entries"), constants))
    mass = call(
        "Mass",
        Code("joints"),
        Code("mass_entries"),
        functions=tuple(map(attrgetter("mean", "scale"), spec.outputs)),
        constants=constants,
        net=_mass_network(body, spec),
        margin=spec.margin,
    )
    return body.let("mass", mass)


def _mass_network(body: _Body, spec: ModelSpec) -> Code:
    """Add the network of M's functions, which reads the joints that they depend on."""
    fewest = TUNING.least_units
    if spec.design.net == "kan":
        fewest = TUNING.least_kan_units
    outputs = tuple(map(attrgetter("joints"), spec.outputs))
    sensitivity = _columns(spec.joints, "mass_sensitivity")["mass_sensitivity"]
    return _network(body, spec, outputs, sensitivity, fewest=fewest)


def _potential(body: _Body, spec: ModelSpec) -> Code:
    sensitivity = _columns(spec.joints, "potential_sensitivity")["potential_sensitivity"]
    width = max(TUNING.least_units, round(TUNING.potential_fraction * units(spec)))
    outputs = (spec.potential,)
    return _network(body, spec, outputs, sensitivity, width=width, name="potential")


def _network(
    body: _Body,
    spec: ModelSpec,
    outputs: tuple[tuple[int, ...], ...],
    sensitivity: object,
    *,
    velocities: tuple[tuple[float, ...], ...] = (),
    depth: int | None = None,
    width: int | None = None,
    fewest: int = 1,
    name: str = "network",
) -> Code:
    """Add a network of ``outputs``, each by the joints that it reads."""
    layers: dict[str, object] = {"hidden": hidden_units(outputs, width or units(spec), fewest)}
    layers["outputs"] = _groups(outputs)
    if (depth or spec.options.depth) != _DEPTH:
        layers["depth"] = depth or spec.options.depth
    inputs = (sensitivity, sensitivity, *velocities)
    return body.let(name, call("Network", Code("generator"), inputs, **layers))


def _friction(body: _Body, spec: ModelSpec) -> Code:
    n = len(spec.joints)
    sensitivity = (TUNING.position_sensitivity,) * n
    if spec.design.dissipation == "per-joint":
        own = tuple((joint,) for joint in range(n))
        width = TUNING.friction_units * n
        velocities = (tuple(float(f"{1 / joint.speed:.4g}") for joint in spec.joints), (1.0,) * n)
        network = _network(body, spec, own, sensitivity, velocities=velocities, width=width, depth=1)
        return body.let("friction", call("Friction", Code("joints"), network))
    axes = _FRICTION_AXES[spec.design.dissipation]
    rows = axes * n
    outputs = (_all(spec),) * (rows * (rows + 1) // 2)
    network = _network(body, spec, outputs, sensitivity, velocities=((1.0,) * n,))
    return body.let("friction", call("Friction", Code("joints"), network, axes=axes))


def mean_mass(spec: ModelSpec) -> tuple[tuple[float, ...], ...]:
    """The lower triangle of the nominal mean of M, row by row."""
    n = len(spec.joints)
    mean = np.zeros((n, n))
    for constant in spec.constants:
        for row, column, value in constant.basis:
            mean[row, column] += constant.start * value
    for output in spec.outputs:
        for row, column, value in output.basis:
            mean[row, column] += output.mean * value
    triangle = []
    for row in range(n):
        triangle.append(tuple(float(f"{value:.6g}") for value in mean[row, : row + 1]))
    return tuple(triangle)
