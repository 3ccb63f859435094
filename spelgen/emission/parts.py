"""ModelSpec -> the parts of a model: one table, from which a model is assembled and a module is written."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from spelgen.design import BREAKAWAY, SERVO_STRIBECK_ROUNDING
from spelgen.emission.entry_sums import mean_mass
from spelgen.emission.source import Call, Code, call
from spelgen.emission.tuning import TUNING
from spelgen.spec import JointSpec, LinkSpec, ModelSpec

GENERATOR, JOINTS, LINKS = Code("generator"), Code("JOINTS"), Code("LINKS")
FUNCTIONS, CONSTANTS, MASS_ENTRIES = Code("FUNCTIONS"), Code("CONSTANTS"), Code("mass_entries")
_FRICTION_AXES = {"dense-n": 1, "dense-3n": 3}
_IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True)
class ModelParts:
    """The rows of an arm by their name, and the call that makes its model from them.

    Calls are to classes of ``spelgen.runtime``. Arguments are numbers, texts, tuples, calls and names: of the rows, of
    ``mass_entries``, and of ``generator``, the random generator of initial weights, used in the order of the calls.
    """

    rows: dict[str, tuple[Call, ...]]
    model: Call

    @property
    def uses_networks(self) -> bool:
        """Whether the model has networks with random initial weights."""
        return _names(self.model, GENERATOR)

    @property
    def uses_mass_entries(self) -> bool:
        """Whether M is a linear combination of functions and constants."""
        return _names(self.model, MASS_ENTRIES)


def model_parts(spec: ModelSpec) -> ModelParts:
    """Return the parts of the model that ``spec`` describes."""
    rows = {"JOINTS": tuple(map(_joint, spec.joints))}
    if spec.links:
        rows["LINKS"] = tuple(_link(spec, link) for link in spec.links)
    is_residual = bool(spec.links)
    # Rigid bodies have functions of M only for their residual, which starts at zero and needs no mean.
    if spec.design.mass == "derived" or (is_residual and spec.design.net != "none"):
        if spec.outputs:
            rows["FUNCTIONS"] = tuple(
                call("Function", _joint_names(spec, x.joints))
                if is_residual
                else call("Function", _joint_names(spec, x.joints), mean=x.mean, scale=x.scale)
                for x in spec.outputs
            )
        if spec.constants and not is_residual:
            rows["CONSTANTS"] = tuple(
                call("Constant", initial=x.start, scale=x.scale) for x in spec.constants
            )
    arguments = _rigid_bodies(spec) if spec.links else _networks(spec)
    if spec.inputs:
        arguments["inputs"] = _inputs(spec)
    return ModelParts(rows, call(base_class(spec), joints=JOINTS, **arguments))


def _inputs(spec: ModelSpec) -> Call:
    n = range(len(spec.joints))
    values = {(x.joint, x.motor): x.value for x in spec.inputs}
    # Trained gains are a mask, so that the values of known gears are constants.
    trained = {(x.joint, x.motor) for x in spec.inputs if x.trained}
    matrix = tuple(tuple(values.get((joint, motor), 0.0) for motor in n) for joint in n)
    if not trained:
        return call("MotorInputs", matrix)
    return call(
        "MotorInputs", matrix, trained=tuple(tuple((joint, motor) in trained for motor in n) for joint in n)
    )


def base_class(spec: ModelSpec) -> str:
    """Return the name of the runtime class of the model."""
    if spec.links:
        return "RigidBodyDynamics" if spec.design.net == "none" else "ResidualDynamics"
    return "DenseInputDynamics" if spec.design.input == "dense-3n" else "NetworkDynamics"


def _names(value: object, name: Code) -> bool:
    """Test whether a value refers to a name."""
    if isinstance(value, Call):
        return any(_names(item, name) for _, item in value.arguments)
    if isinstance(value, tuple):
        return any(_names(item, name) for item in value)
    return value == name


def _joint(joint: JointSpec) -> Call:
    fields: dict[str, object] = {"lower": joint.lower, "upper": joint.upper, "speed": joint.speed}
    fields |= {"friction": joint.friction, "armature": joint.armature}
    # Default values are omitted: a row shows in which respect its joint is special.
    if joint.gear != 1:
        fields["gear"] = joint.gear
    if (joint.center, joint.half_range) != _range_of_limits(joint):
        fields["typical_range"] = (joint.center, joint.half_range)
    return call("Joint", joint.name, joint.joint_type, **fields)


def _range_of_limits(joint: JointSpec) -> tuple[float, float] | None:
    """Return center and half range of the limits, as `runtime.rows.Joint` rounds them; None without limits."""
    if joint.lower is None or joint.upper is None:
        return None
    middle, half = (joint.lower + joint.upper) / 2, (joint.upper - joint.lower) / 2
    return float(f"{middle:.6g}"), float(f"{half:.6g}")


def _link(spec: ModelSpec, link: LinkSpec) -> Call:
    joint = spec.joints[link.joint]
    fields: dict[str, object] = {
        "parent": None if link.parent < 0 else spec.links[link.parent].name,
        "joint": joint.name,
        "position": link.position,
    }
    if link.rotation != _IDENTITY:
        fields["rotation"] = link.rotation
    fields |= {"mass": link.mass, "center_of_mass": link.center_of_mass, "inertia": link.inertia}
    if link.ratio != 1:
        fields["ratio"] = link.ratio
    if link.offset != 0:
        fields["offset"] = link.offset
    if link.joint_type != joint.joint_type:
        fields["joint_type"] = link.joint_type
    return call("Link", link.name, **fields)


def _rigid_bodies(spec: ModelSpec) -> dict[str, object]:
    """Return the arguments of a model of rigid bodies."""
    arguments: dict[str, object] = {"links": LINKS, "gravity": spec.gravity, "friction": _friction_laws(spec)}
    if spec.motor_speeds:
        arguments["motor_speeds"] = spec.motor_speeds
    if spec.servos:
        arguments["servo"] = call(
            "PositionServo",
            kp=tuple(servo.kp for servo in spec.servos),
            kd=tuple(servo.kd for servo in spec.servos),
            limit=tuple(servo.limit for servo in spec.servos),
            known=tuple(servo.known for servo in spec.servos),
        )
    if spec.design.net != "none":
        networks: dict[str, object] = {}
        if spec.outputs:
            networks["network"] = _mass_network(spec)
        if spec.potential:
            networks["potential"] = _potential(spec)
        scale = {"potential_scale": spec.potential_scale} if spec.potential else {}
        arguments["residuals"] = call(
            "ResidualTerms",
            JOINTS,
            MASS_ENTRIES,
            functions=len(spec.outputs),
            constants=len(spec.constants),
            **scale,
            **networks,
        )
    return arguments


def _friction_laws(spec: ModelSpec) -> Call:
    if spec.design.memory == "none":
        return call("SlidingFriction", JOINTS)
    # of the types of the arm's joints, in the order of the table
    types = [name for name in BREAKAWAY if name in spec.joint_types]
    breakaway = call("dict", **{name: BREAKAWAY[name] for name in types})
    rounding = {"stribeck_rounding": SERVO_STRIBECK_ROUNDING} if spec.servos else {}
    return call("FrictionLaws", JOINTS, breakaway=breakaway, **rounding)


def _networks(spec: ModelSpec) -> dict[str, object]:
    """Return the arguments of a model of networks, in the order of their random initial weights."""
    n = len(spec.joints)
    ones = (1.0,) * n
    arguments: dict[str, object] = {"mass": _mass(spec)}
    if spec.potential:
        arguments |= {"potential": _potential(spec), "potential_scale": spec.potential_scale}
    else:
        # one output that depends on no joint
        constant = _network(spec, ((),), (ones, ones), width=1, depth=0)
        arguments |= {"potential": constant, "potential_scale": 1.0}
    arguments["friction"] = _friction(spec)
    if spec.design.input == "dense-3n":
        arguments["input_network"] = _network(spec, (spec.joint_names,) * (3 * n), (ones, ones))
    return arguments


def _mass(spec: ModelSpec) -> Call:
    if spec.design.mass == "dense-3n":
        rows = 3 * len(spec.joints)
        outputs = (spec.joint_names,) * (rows * (rows + 1) // 2)
        # The nominal mean of M, by its lower triangle: M is symmetric.
        mean = mean_mass(len(spec.joints), spec.outputs, spec.constants)
        triangle = tuple(tuple(row[: k + 1]) for k, row in enumerate(mean.tolist()))
        return call("DenseMass", JOINTS, mean=triangle, network=_network(spec, outputs, _mass_scales(spec)))
    constants = CONSTANTS if spec.constants else ()
    if not spec.outputs:
        return call("ConstantMass", JOINTS, MASS_ENTRIES, constants=constants)
    return call(
        "DerivedMass",
        JOINTS,
        MASS_ENTRIES,
        functions=FUNCTIONS,
        constants=constants,
        margin=spec.margin,
        network=_mass_network(spec),
    )


def _mass_network(spec: ModelSpec) -> Call:
    """Return the network of the functions of M."""
    # A unit of a KAN has a function per edge: fewer units suffice.
    min_units = TUNING.min_kan_units if spec.design.net == "kan" else TUNING.min_units
    return _network(spec, call("joints_of", FUNCTIONS), _mass_scales(spec), min_units=min_units)


def _mass_scales(spec: ModelSpec) -> tuple[tuple[float, ...], ...]:
    """Return the scales of cos q, or the scaled q, and of sin q."""
    return (tuple(joint.mass_sensitivity for joint in spec.joints),) * 2


def _potential(spec: ModelSpec) -> Call:
    scales = (tuple(joint.potential_sensitivity for joint in spec.joints),) * 2
    # V is one output, M has many: a part of the units is enough.
    width = max(TUNING.min_units, round(TUNING.potential_fraction * units(spec)))
    return _network(spec, (_joint_names(spec, spec.potential),), scales, width=width)


def _friction(spec: ModelSpec) -> Call:
    n = len(spec.joints)
    scale, ones = (TUNING.position_sensitivity,) * n, (1.0,) * n
    if spec.design.dissipation == "per-joint":
        outputs = tuple((name,) for name in spec.joint_names)
        # Velocities in units of the typical speed; qd / |qd| is scaled already.
        speeds = tuple(float(f"{1 / joint.speed:.4g}") for joint in spec.joints)
        width = TUNING.friction_units * n
        network = _network(spec, outputs, (scale, scale, speeds, ones), width=width, depth=1)
        return call("JointFriction", JOINTS, network=network)
    axes = _FRICTION_AXES[spec.design.dissipation]
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
    """Return a network with these outputs: for each, the names of the joints that it depends on."""
    return call(
        "MaskedKAN" if spec.design.net == "kan" else "MaskedMLP",
        GENERATOR,
        JOINTS,
        scales=scales,
        outputs=outputs,
        width=units(spec) if width is None else width,
        depth=spec.options.depth if depth is None else depth,
        **({} if min_units == 1 else {"min_units": min_units}),
    )


def units(spec: ModelSpec) -> int:
    """Return the units of a hidden layer: fewer of a Kolmogorov-Arnold network, which has a grid on every edge."""
    width = spec.options.width
    return width if spec.design.net == "mlp" else max(TUNING.min_units, round(TUNING.kan_fraction * width))


def _joint_names(spec: ModelSpec, joints: Sequence[int]) -> tuple[str, ...]:
    return tuple(spec.joints[joint].name for joint in joints)
