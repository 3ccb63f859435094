"""Conversion of a ``ModelSpec`` to tables and constructor calls of the classes of ``spelgen.runtime``.

The tables have the joints and links of the arm, and the functions and constants of M.

Models in memory (`assemble`) and the source of modules (`text`) are both made from these tables and calls.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spelgen.design import BREAKAWAY, SERVO_STRIBECK_ROUNDING
from spelgen.spec import ConstantSpec, JointSpec, LinkSpec, ModelSpec, OutputSpec


@dataclass(frozen=True)
class Code:
    """A name in source code, such as the name of a table, written without quotes; a ``str`` is a string literal."""

    text: str


@dataclass(frozen=True)
class Call:
    """A call of a class or function in source code.

    arguments: pairs (name, value); the name of a positional argument is None.
    """

    callee: str
    arguments: tuple[tuple[str | None, object], ...]


def call(callee: str, *positional: object, **named: object) -> Call:
    """Return a ``Call`` of ``callee`` with the given positional and keyword arguments."""
    arguments = [(None, value) for value in positional]
    return Call(callee, (*arguments, *named.items()))


GENERATOR, JOINTS, LINKS = Code("generator"), Code("JOINTS"), Code("LINKS")
FUNCTIONS, CONSTANTS, MASS_ENTRIES = Code("FUNCTIONS"), Code("CONSTANTS"), Code("mass_entries")


@dataclass(frozen=True)
class NetworkTuning:
    """Constants with which networks are built, before training: numbers of hidden units, and the scale of inputs."""

    # [1] Factor of the inputs of friction networks that encode positions, such as cos q and sin q. The other inputs are
    # velocities, divided by typical speeds. The factor is below one, so that an untrained network depends less on
    # positions than on velocities.
    position_sensitivity: float = 0.1
    # [1] Number of hidden units per joint of the friction networks.
    friction_units: int = 8
    # [1] Smallest number of hidden units per group of outputs. A group has all outputs of a network that depend on the
    # same joints.
    min_units: int = 4
    # [1] The same number for a Kolmogorov-Arnold network; smaller than `min_units`, because each edge of such a network
    # has a learned function.
    min_kan_units: int = 2
    # [1] Number of hidden units of Kolmogorov-Arnold networks, divided by the number for multilayer perceptrons (the
    # option `width`); smaller, because each edge has several weights.
    kan_fraction: float = 0.25
    # [1] Number of hidden units of the network of V, divided by the number of the network of M; smaller, because V is a
    # single output.
    potential_fraction: float = 0.5


TUNING = NetworkTuning()


@dataclass(frozen=True)
class ModelParts:
    """The tables of an arm, and the constructor call of its model, whose arguments refer to the tables.

    Attributes:
        rows: {name of a table: rows}. The tables are ``JOINTS``, ``LINKS``, ``FUNCTIONS`` and ``CONSTANTS``; a row is a
            call of ``Joint``, ``Link``, ``Function`` or ``Constant``.
        model: the constructor call of the model.

    An argument of a call is a number, a text, a tuple, a call or a name. A name refers to a table, to the function
    ``mass_entries``, or to ``generator``, the random generator of the initial weights. The calls must be evaluated in
    their order, which determines the initial weights.
    """

    rows: dict[str, tuple[Call, ...]]
    model: Call


def model_parts(spec: ModelSpec) -> ModelParts:
    """Return the tables (joints, links, functions, constants) and the constructor call of the model of ``spec``."""
    rows = {"JOINTS": tuple(map(_joint, spec.joints))}
    if spec.links:
        rows["LINKS"] = tuple(_link(spec, link) for link in spec.links)
    if spec.outputs and spec.links and spec.design.net != "none":
        # The learned functions of R, the residual term of M, are scaled by bounds that the model computes from the
        # armature, so that armature + R is positive definite. A row of the table therefore has the joints of a
        # function, but no mean and scale.
        rows["FUNCTIONS"] = tuple(call("Function", _joint_names(spec, x.joints)) for x in spec.outputs)
    elif spec.design.mass == "derived":
        functions = [
            call("Function", _joint_names(spec, x.joints), mean=x.mean, scale=x.scale) for x in spec.outputs
        ]
        constants = [call("Constant", initial=x.start, scale=x.scale) for x in spec.constants]
        rows |= {k: tuple(v) for k, v in (("FUNCTIONS", functions), ("CONSTANTS", constants)) if v}
    arguments = _rigid_bodies(spec) if spec.links else _networks(spec)
    if spec.inputs:
        arguments["inputs"] = _inputs(spec)
    return ModelParts(rows, call(base_class(spec), joints=JOINTS, **arguments))


def _inputs(spec: ModelSpec) -> Call:
    n = len(spec.joints)
    # `is_trained` is True for gains (entries of G) that are trained; known gear ratios are constants.
    gains, is_trained = np.zeros((n, n)), np.zeros((n, n), dtype=bool)
    for entry in spec.inputs:
        gains[entry.joint, entry.motor] = entry.value
        is_trained[entry.joint, entry.motor] = entry.trained
    masks = {"trained": tuple(map(tuple, is_trained.tolist()))} if is_trained.any() else {}
    return call("MotorInputs", tuple(map(tuple, gains.tolist())), **masks)


def base_class(spec: ModelSpec) -> str:
    """Return the name of the class of ``spelgen.runtime`` from which the model that ``spec`` describes is derived."""
    if spec.links:
        return "RigidBodyDynamics" if spec.design.net == "none" else "ResidualDynamics"
    return "DenseInputDynamics" if spec.design.input == "dense-3n" else "NetworkDynamics"


def _without_defaults(fields: dict[str, object], **is_default: bool) -> dict[str, object]:
    """Return ``fields`` without arguments that have their default values, so that the rows of a module are short.

    fields: {name of a keyword argument: value}. is_default: {name of an argument: True if its value is the default}.
    Arguments that are not in ``is_default`` are kept.
    """
    return {name: value for name, value in fields.items() if not is_default.get(name)}


def _joint(joint: JointSpec) -> Call:
    typical, limits = (joint.center, joint.half_range), None
    if joint.lower is not None and joint.upper is not None:
        # `typical_range` is (center, half range). By default, `runtime.rows.Joint` computes it from the limits, with
        # the rounding used here: the row of a joint omits `typical_range` if it has its default value.
        limits = rounded((joint.lower + joint.upper) / 2), rounded((joint.upper - joint.lower) / 2)
    fields = {"lower": joint.lower, "upper": joint.upper, "speed": joint.speed, "friction": joint.friction}
    fields |= {"armature": joint.armature, "gear": joint.gear}
    statements = _without_defaults(
        fields | {"typical_range": typical}, gear=joint.gear == 1, typical_range=typical == limits
    )
    return call("Joint", joint.name, joint.joint_type, **statements)


def _link(spec: ModelSpec, link: LinkSpec) -> Call:
    joint = spec.joints[link.joint]
    fields: dict[str, object] = {
        "parent": None if link.parent < 0 else spec.links[link.parent].name,
        "joint": joint.name,
        "position": link.position,
        "rotation": link.rotation,
        "mass": link.mass,
        "center_of_mass": link.center_of_mass,
        "inertia": link.inertia,
        "ratio": link.ratio,
        "offset": link.offset,
        "joint_type": link.joint_type,
    }
    statements = _without_defaults(
        fields,
        rotation=np.array_equal(link.rotation, np.eye(3)),
        ratio=link.ratio == 1,
        offset=link.offset == 0,
        joint_type=link.joint_type == joint.joint_type,
    )
    return call("Link", link.name, **statements)


def _rigid_bodies(spec: ModelSpec) -> dict[str, object]:
    """Return the keyword arguments of the constructor of a rigid-body model, except for ``joints`` and ``inputs``."""
    arguments = {"links": LINKS, "gravity": spec.gravity, "friction": _friction_laws(spec)}
    if spec.motor_speeds:
        arguments["motor_speeds"] = spec.motor_speeds
    if spec.servos:
        columns = {name: tuple(vars(x)[name] for x in spec.servos) for name in ("kp", "kd", "limit", "known")}
        arguments["servo"] = call("PositionServo", **columns)
    if spec.design.net != "none":
        terms: dict[str, object] = {"functions": len(spec.outputs), "constants": len(spec.constants)}
        # The order of the networks `network` and `potential` determines their initial weights, since both use one
        # random generator.
        if spec.potential:
            terms["potential_scale"] = spec.potential_scale
        if spec.outputs:
            terms["network"] = _mass_network(spec)
        if spec.potential:
            terms["potential"] = _potential(spec)
        arguments["residuals"] = call("ResidualTerms", JOINTS, MASS_ENTRIES, **terms)
    return arguments


def _friction_laws(spec: ModelSpec) -> Call:
    if spec.design.memory == "none":
        return call("SlidingFriction", JOINTS)
    # The rows of `breakaway`, one per joint type of the arm, have the order of BREAKAWAY, so that the text of a module
    # is deterministic.
    breakaway = {name: row for name, row in BREAKAWAY.items() if name in spec.joint_types}
    rounding = {"stribeck_rounding": SERVO_STRIBECK_ROUNDING} if spec.servos else {}
    return call("FrictionLaws", JOINTS, breakaway=breakaway, **rounding)


def _networks(spec: ModelSpec) -> dict[str, object]:
    """Return the keyword arguments of the constructor of a network model, except for ``joints`` and ``inputs``.

    The order of the arguments determines the initial weights, since all networks use one random generator.
    """
    n = len(spec.joints)
    ones = (1.0,) * n
    mass = _mass(spec)
    # A constant V also has a network, since the class requires one: with one output, which depends on no joint.
    potential = _potential(spec) if spec.potential else _network(spec, ((),), (ones, ones), width=1, depth=0)
    scale = spec.potential_scale if spec.potential else 1.0
    arguments = {"mass": mass, "potential": potential, "potential_scale": scale}
    arguments["friction"] = _friction(spec)
    if spec.design.input == "dense-3n":
        arguments["input_network"] = _network(spec, (spec.joint_names,) * (3 * n), (ones, ones))
    return arguments


def _mass(spec: ModelSpec) -> Call:
    if spec.design.mass == "dense-3n":
        rows = 3 * len(spec.joints)
        outputs = (spec.joint_names,) * (rows * (rows + 1) // 2)
        # M is symmetric, so a module has only the lower triangle of the mean of the nominal M over positions.
        mean = mean_mass(len(spec.joints), spec.outputs, spec.constants)
        triangle = tuple(tuple(row[: k + 1]) for k, row in enumerate(mean.tolist()))
        return call("DenseMass", JOINTS, mean=triangle, network=_network(spec, outputs, _mass_scales(spec)))
    constants = CONSTANTS if spec.constants else ()
    if not spec.outputs:
        return call("ConstantMass", JOINTS, MASS_ENTRIES, constants=constants)
    options = {"functions": FUNCTIONS, "constants": constants, "margin": spec.margin}
    return call("DerivedMass", JOINTS, MASS_ENTRIES, **options, network=_mass_network(spec))


def _mass_network(spec: ModelSpec) -> Call:
    """Return the constructor call of the network whose outputs are the learned functions of q in the entries of M."""
    # Each edge of a Kolmogorov-Arnold network is a learned function, so fewer units suffice.
    min_units = TUNING.min_kan_units if spec.design.net == "kan" else TUNING.min_units
    return _network(spec, call("joints_of", FUNCTIONS), _mass_scales(spec), min_units=min_units)


def _mass_scales(spec: ModelSpec) -> tuple[tuple[float, ...], ...]:
    """Return the factors by which the inputs of the network of M are multiplied: two rows, (n,) each.

    The first row is for the inputs cos q (scaled q of a prismatic joint), the second for the inputs sin q. The rows are
    equal, since a factor depends only on the joint: the root mean square change of M due to a change of the joint's
    position, divided by the largest such value of all joints.
    """
    return (tuple(joint.mass_sensitivity for joint in spec.joints),) * 2


def _potential(spec: ModelSpec) -> Call:
    # The inputs cos q and sin q of a joint are multiplied by the same factor, the sensitivity of V to the joint's
    # position.
    scales = (tuple(joint.potential_sensitivity for joint in spec.joints),) * 2
    # The network of V has a single output, the network of M has many: a fraction of its hidden units suffices for V.
    width = max(TUNING.min_units, round(TUNING.potential_fraction * units(spec)))
    return _network(spec, (_joint_names(spec, spec.potential),), scales, width=width)


def _friction(spec: ModelSpec) -> Call:
    n = len(spec.joints)
    scale, ones = (TUNING.position_sensitivity,) * n, (1.0,) * n
    if spec.design.dissipation == "per-joint":
        outputs = tuple((name,) for name in spec.joint_names)
        # The inputs qd of the friction network are divided by the typical speed; its inputs qd / |qd| have magnitude 1.
        speeds = tuple(rounded(1 / joint.speed, 4) for joint in spec.joints)
        width = TUNING.friction_units * n
        network = _network(spec, outputs, (scale, scale, speeds, ones), width=width, depth=1)
        return call("JointFriction", JOINTS, network=network)
    # Dense friction of the published model (Duong et al., IEEE T-RO 40:3695, 2024) has rows for all three axes of each
    # joint frame, although a joint moves about or along one axis only.
    axes = 3 if spec.design.dissipation == "dense-3n" else 1
    rows = axes * n
    network = _network(spec, (spec.joint_names,) * (rows * (rows + 1) // 2), (scale, scale, ones))
    return call("DenseFriction", JOINTS, axes=axes, network=network)


def _network(
    spec: ModelSpec,
    outputs: object,
    scales: tuple[tuple[float, ...], ...],
    *,
    width: int | None = None,
    depth: int | None = None,
    min_units: int = 1,
) -> Call:
    """Return the constructor call of a network: ``MaskedKAN`` if the design has ``net: kan``, else ``MaskedMLP``.

    Args:
        spec: specification of the model, with width and depth of networks.
        outputs: names of the joints that each output depends on, as a tuple, or as a call that returns them.
        scales: scales of the inputs, one row (n,) per input of a joint, such as cos q and sin q.
        width: number of hidden units per layer; None: ``units(spec)``.
        depth: number of hidden layers; None: the option of the specification.
        min_units: smallest number of hidden units per group of outputs that depend on the same joints.
    """
    options = {
        "scales": scales,
        "outputs": outputs,
        "width": units(spec) if width is None else width,
        "depth": spec.options.depth if depth is None else depth,
        "min_units": min_units,
    }
    kind = "MaskedKAN" if spec.design.net == "kan" else "MaskedMLP"
    return call(kind, GENERATOR, JOINTS, **_without_defaults(options, min_units=min_units == 1))


def units(spec: ModelSpec) -> int:
    """Return the number of units of a hidden layer: the option ``width``, or fewer for Kolmogorov-Arnold networks.

    Kolmogorov-Arnold networks need fewer units, because each edge has several weights.
    """
    width = spec.options.width
    return width if spec.design.net == "mlp" else max(TUNING.min_units, round(TUNING.kan_fraction * width))


def _joint_names(spec: ModelSpec, joints: Sequence[int]) -> tuple[str, ...]:
    return tuple(spec.joints[joint].name for joint in joints)


def rounded(value: float, digits: int = 6) -> float:
    """Return ``value`` rounded to ``digits`` significant digits."""
    return float(f"{value:.{digits}g}")


Sums = list[tuple[float, int]]
"""An entry of M as a linear combination: pairs (factor, index of a function or constant), positive factors first."""


def entry_sums(spec: ModelSpec) -> list[list[Sums]]:
    """Return the entries of the lower triangle of M as linear combinations of learned functions and trained constants.

    The result has one list per row of M. It contains, for each entry of the row, a list of pairs (factor, index): the
    entry is the sum of factor times the function or constant with this index. The functions of the specification have
    the first indices, its constants the following ones. An entry that is always zero has an empty list.
    """
    cells: defaultdict[tuple[int, int], Sums] = defaultdict(list)
    terms: Sequence[OutputSpec | ConstantSpec] = (*spec.outputs, *spec.constants)
    for index, term in enumerate(terms):
        for row, column, factor in term.basis:
            cells[row, column].append((factor, index))
    # Positive factors come first, so that the expression of an entry of M does not start with a minus sign unless all
    # factors are negative.
    ordered = {entry: sorted(sums, key=lambda term: term[0] < 0) for entry, sums in cells.items()}
    return [[ordered.get((row, column), []) for column in range(row + 1)] for row in range(len(spec.joints))]


def mean_mass(n: int, outputs: Sequence[OutputSpec], constants: Sequence[ConstantSpec]) -> np.ndarray:
    """Return the lower triangle of the mean of M without armature, (n, n) [kg m^2, kg m, kg], to 6 significant digits.

    The mean is over random positions, for nominal inertial parameters. Elements above the diagonal are zero. outputs,
    constants: the terms of M. In the sum of the terms, each function of q is replaced by its mean (`OutputSpec.mean`),
    each constant by its initial value (`ConstantSpec.start`).
    """
    mean = np.zeros((n, n))
    for constant in constants:
        for row, column, value in constant.basis:
            mean[row, column] += constant.start * value
    for output in outputs:
        for row, column, value in output.basis:
            mean[row, column] += output.mean * value
    return np.asarray(np.vectorize(rounded)(mean))
