"""The function ``derive_spec``: the ``ModelSpec`` of an arm, from its structure, nominal values and settings."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from spelgen.arm.actuation import Actuation
from spelgen.arm.arm import Chain, Coordinate
from spelgen.arm.configured_arm import Arm
from spelgen.arm.rational import Vector
from spelgen.design import Design, load_design
from spelgen.emission.parts import mean_mass, rounded
from spelgen.errors import SettingsError
from spelgen.settings.settings import JointSettings
from spelgen.spec import (
    ConstantSpec,
    Entries,
    InputSpec,
    JointSpec,
    LinkSpec,
    ModelSpec,
    Options,
    OutputSpec,
    ServoSpec,
    Triple,
)
from spelgen.structure.basis import Weights
from spelgen.structure.nominal import Nominal, exact_inertias, nominal, parameters_of, reference_factor
from spelgen.structure.structure import Structure, derive


@dataclass(frozen=True)
class ModelTuning:
    """Constants of untrained models: initial values of drives, servos and friction that the URDF does not contain."""

    # [1] Lower bound of the generalised eigenvalues of a trained M, divided by the smallest generalised eigenvalue of
    # the nominal M at random positions. A generalised eigenvalue x of M solves M v = x M0 v, with the mean M0 of the
    # nominal M over these positions.
    margin: float = 0.1
    # [1] Typical friction, divided by the effort limit of the drive: gears lose some per cent of the torque.
    friction_of_effort: float = 0.02
    # [1] Typical friction, divided by the joint's typical torque for gravity and unit acceleration, for joints without
    # an effort limit.
    friction_of_torque: float = 0.1
    # [1] Significant digits of inertial parameters: more than a URDF has, but fewer than the 16 of float64, so that
    # decimals of a URDF are reproduced without rounding errors of float64.
    inertia_digits: int = 12
    # [1] Smallest allowed principal second moment of mass of a body about its center of mass, divided by the largest:
    # large enough that rounding errors do not make the body physically inconsistent.
    min_second_moment: float = 1e-10
    # [rad/s] Typical speed of a revolute joint without a velocity limit.
    angular_speed: float = 2.0
    # [m/s] Typical speed of a prismatic joint without a velocity limit.
    linear_speed: float = 0.5
    # [s] Time in which the effort limit accelerates the armature of a drive with unknown rotor inertia to full speed:
    # the armature is initially this time * effort / speed.
    rise: float = 0.02
    # [Nm, N] Full effort of a servo without an effort limit, which determines the initial kp.
    servo_effort: float = 5.0
    # [rad, m] A servo with unknown kp starts the fit with kp = full effort / this position error.
    full_effort_at: float = 0.5
    # [s] Ratio kd / kp with which each servo starts the fit.
    servo_lag: float = 0.05
    # [1] Armature of a drive with unknown rotor inertia and an unknown limit of effort or speed, divided by the joint's
    # diagonal entry of the nominal M.
    min_armature: float = 0.01


TUNING = ModelTuning()


def derive_spec(arm: Arm, options: Options) -> ModelSpec:
    """Return the specification of the model of ``arm`` for the preset or design and the other values in ``options``.

    Raises SettingsError for position servos with a design without bristle friction.
    """
    design = load_design(options.design or options.preset)
    has_servos = arm.settings.input == "position"
    if has_servos and design.memory == "none":
        raise SettingsError(
            f"position servos with the preset {options.preset}", element="input",
            expected="a preset with bristle friction, which position servos need", do="--preset closed-form",
        )  # fmt: skip
    structure = derive(arm.chain, options.assume)
    # `sizes`: typical magnitudes of M, V and torques, by which networks and friction are scaled. They are computed with
    # the inertials of the URDF or, if the inertials are absent or inconsistent, with default inertials.
    sizes = nominal(arm.chain, structure)
    coordinates = arm.chain.coordinates
    drives = [arm.settings.joint(x.name) for x in coordinates]
    outputs, constants = _outputs(structure, sizes, design), _constants(structure, sizes)
    links: tuple[LinkSpec, ...] = ()
    min_armatures = np.zeros(len(drives))
    if design.mass == "closed-form":
        # A URDF may have inertials that are not physically consistent; `_links` corrects the inertials.
        links = _links(arm.chain, exact_inertias(arm.chain, sizes.from_urdf))
        min_armatures = TUNING.min_armature * np.diagonal(mean_mass(len(drives), outputs, constants))
    rows = enumerate(zip(coordinates, drives, min_armatures.tolist(), strict=True))
    joints = [_joint(x, sizes, index, drive, min_armature) for index, (x, drive, min_armature) in rows]
    x, y, z = map(float, arm.chain.gravity)
    return ModelSpec(
        robot=arm.chain.name,
        urdf=arm.robot.path.name,
        urdf_sha256=arm.robot.digest,
        gravity=(x, y, z),
        options=options,
        design=design,
        joints=tuple(joints),
        entries=tuple((e.row, e.column, e.kind, e.joints) for e in structure.entries),
        outputs=outputs,
        constants=constants,
        potential=tuple(range(len(joints))) if design.potential == "dense" else structure.potential,
        potential_scale=sizes.potential_scale,
        # The lower bound of the eigenvalues of M (relative to the nominal mean of M) is rounded to one digit, so that
        # rounding errors of nominal values do not change the text of the module.
        margin=float(f"{max(TUNING.margin * sizes.min_eigenvalue, 1e-4):.0e}"),
        started_from_urdf=sizes.from_urdf,
        links=links,
        inputs=_inputs(arm.actuation, design),
        motor_speeds=_motor_speeds(arm.actuation),
        servos=tuple(map(_servo, coordinates, drives)) if has_servos else (),
    )


def _inputs(actuation: Actuation, design: Design) -> tuple[InputSpec, ...]:
    """Return the nonzero entries of the input matrix G; trained entries have an initial value.

    The result is empty if each input is the torque of its own joint (G is the identity), or if a network gives G.
    """
    entries = actuation.entries
    if design.input != "derived" or (actuation.direct and len(entries) == actuation.joints):
        return ()
    return tuple(InputSpec(x.row, x.column, x.value, x.kind == "gain") for x in entries)


def _outputs(structure: Structure, sizes: Nominal, design: Design) -> tuple[OutputSpec, ...]:
    """Return an ``OutputSpec`` per learned function f_k of M = sum_k f_k(q) A_k + constant terms.

    An ``OutputSpec`` has the joints on which f_k depends, the matrix A_k, and the nominal mean and scale of f_k.

    structure: terms of M. sizes: nominal means and standard deviations of the functions. design: gives the encoding of
    q: with "lie-group", each function depends on all joints.
    """
    outputs = []
    for output, mean, scale in zip(structure.outputs, sizes.output_means, sizes.output_scales, strict=True):
        joints = output.joints
        # With the encoding of Duong et al. (IEEE T-RO 40:3695, 2024), every function depends on all joints.
        if design.encoding == "lie-group":
            joints = tuple(range(len(sizes.mass_sensitivities)))
        outputs.append(OutputSpec(joints, _entries(output.basis), mean, scale))
    return tuple(outputs)


def _constants(structure: Structure, sizes: Nominal) -> tuple[ConstantSpec, ...]:
    """Return a ``ConstantSpec`` per trained constant c_k of M: the matrix that c_k multiplies, initial value and scale.

    structure: terms of M. sizes: nominal values of the constants.
    """
    values = zip(structure.constants, sizes.constants, sizes.constant_scales, strict=True)
    return tuple(
        ConstantSpec(_entries(constant.basis), initial, scale) for constant, initial, scale in values
    )


def _motor_speeds(actuation: Actuation) -> tuple[tuple[float, ...], ...]:
    """Return the rows of the matrix C, for which C qd are the motor velocities; () if C is the identity."""
    speeds = actuation.drives().speeds
    # Most arms have no coupled motors: C, the motor velocities per joint velocity, is the identity and is omitted from
    # the module.
    if np.array_equal(speeds, np.eye(actuation.joints)):
        return ()
    return tuple(map(tuple, speeds.tolist()))


def _joint(
    coordinate: Coordinate, sizes: Nominal, index: int, drive: JointSettings, min_armature: float
) -> JointSpec:
    """Return the ``JointSpec`` of a coordinate: limits, typical friction, armature, and sensitivities of M and V to q.

    Args:
        coordinate: joint with the limits of the URDF.
        sizes: typical magnitudes of M, potential energy V and torques.
        index: index of the coordinate, from 0.
        drive: settings of the joint's drive.
        min_armature: armature [kg m^2, kg] of a drive with unknown rotor inertia, if its effort limit or its speed
            limit is unknown, too.
    """
    # The working range defines center and half range, since it exists even if the URDF has no limits.
    low, high = coordinate.working_range
    lower, upper = (None if x is None else rounded(x) for x in (coordinate.lower, coordinate.upper))
    effort, speed = coordinate.effort, coordinate.velocity
    # If the rotor inertia is unknown, the armature is such that full effort accelerates it to full speed in ``rise``
    # seconds.
    armature = TUNING.rise * effort / speed if effort and speed else 0.0
    # Typical friction is a fraction of the joint's torque. The torque of a wrist joint may be negligible, but its gear
    # has friction: at least 1 % of the largest torque of all joints is assumed.
    torque = max(sizes.joint_torque[index], 0.01 * max(sizes.joint_torque))
    friction = TUNING.friction_of_effort * effort if effort else TUNING.friction_of_torque * torque
    default_speed = TUNING.angular_speed if coordinate.joint_type == "revolute" else TUNING.linear_speed
    return JointSpec(
        name=coordinate.name,
        joint_type=coordinate.joint_type,
        lower=lower,
        upper=upper,
        center=rounded((low + high) / 2),
        half_range=rounded((high - low) / 2),
        speed=speed or default_speed,
        friction=rounded(friction, 3),
        armature=rounded(drive.armature or armature, 3) or rounded(min_armature, 3),
        gear=drive.gear,
        mass_sensitivity=sizes.mass_sensitivities[index],
        potential_sensitivity=sizes.potential_sensitivities[index],
    )


def _servo(coordinate: Coordinate, drive: JointSettings) -> ServoSpec:
    """Return the ``ServoSpec`` of a joint with a position servo: kp, kd and torque limit.

    An unknown kp is initially such that the servo has its full effort at the position error `full_effort_at`.
    """
    # A known kp stays constant; a guessed kp is trained.
    kp = drive.kp or rounded((coordinate.effort or TUNING.servo_effort) / TUNING.full_effort_at, 3)
    return ServoSpec(kp, drive.kp is not None, rounded(TUNING.servo_lag * kp, 3), coordinate.effort)


def _entries(weights: Weights) -> Entries:
    return tuple((row, column, float(value)) for row, column, value in weights)


def _links(arm: Chain, inertias: Sequence[Sequence[Fraction | float]]) -> tuple[LinkSpec, ...]:
    """Return a ``LinkSpec`` for each body of ``arm``, with inertial parameters that are physically consistent.

    inertias: (m, m c, Ixx, Ixy, Ixz, Iyy, Iyz, Izz) of each body about the origin of its joint frame, (10,) each.
    Inconsistent parameters are corrected by `_consistent`.
    """
    specs = []
    for body, ten in zip(arm.bodies, inertias, strict=True):
        mass, center, inertia = _about_center(_consistent(ten))
        first, second, third = map(_triple, body.rotation)
        spec = LinkSpec(
            name=body.link,
            parent=body.parent,
            joint=body.coordinate,
            joint_type=body.joint_type,
            ratio=float(body.multiplier),
            offset=body.offset,
            position=_triple(body.translation),
            rotation=(first, second, third),
            mass=mass,
            center_of_mass=center,
            inertia=inertia,
        )
        specs.append(spec)
    return tuple(specs)


def _consistent(ten: Sequence[Fraction | float]) -> Sequence[Fraction | float]:
    """Return the inertial parameters ``ten`` of a body, (10,), made physically consistent if necessary.

    Eigenvalues of the pseudo-inertia that are not positive are raised (see `reference_factor`). Principal second
    moments of mass below `min_second_moment` times the largest are raised, too.
    """
    factor, is_consistent = reference_factor(np.array(ten, dtype=float))
    pseudo = factor @ factor.T
    mass, center = pseudo[3, 3], pseudo[:3, 3] / pseudo[3, 3]
    moments = pseudo[:3, :3] - mass * np.outer(center, center)
    # A consistent body is also changed if a second moment is below `min_second_moment` times the largest: rounding to
    # `inertia_digits` digits could make the body physically inconsistent.
    values, vectors = np.linalg.eigh(moments)
    if is_consistent and values[0] > TUNING.min_second_moment * values[-1]:
        return ten
    # Principal second moments below twice the bound are raised to twice the bound, so that rounding cannot make one
    # smaller than the bound. All others and the principal directions are unchanged.
    raised = np.maximum(values, 2 * TUNING.min_second_moment * values[-1])
    pseudo[:3, :3] += (vectors * (raised - values)) @ vectors.T
    return _significant(parameters_of(pseudo))


def _about_center(
    ten: Sequence[Fraction | float],
) -> tuple[float, Triple, tuple[float, float, float, float, float, float]]:
    """Return mass [kg], center of mass (3,) [m], and inertia about the center of mass, (6,) [kg m^2], of a body.

    ten: inertial parameters about the origin of the joint frame, (10,). Results are computed exactly, then rounded.
    """
    m, hx, hy, hz, *tensor = [Fraction(value) for value in ten]
    x, y, z = hx / m, hy / m, hz / m
    steiner = (y * y + z * z, -x * y, -x * z, x * x + z * z, -y * z, x * x + y * y)
    inertia = [value - m * square for value, square in zip(tensor, steiner, strict=True)]
    # If `_consistent` has changed the parameters, they have rounding errors of floating point: elements of the inertia
    # that are as small as these errors become zero.
    noise = max(map(abs, inertia)) / 10 ** (TUNING.inertia_digits + 3)
    inertia = [value if abs(value) > noise else Fraction(0) for value in inertia]
    mass, cx, cy, cz, xx, xy, xz, yy, yz, zz = _significant([m, x, y, z, *inertia])
    return mass, (cx, cy, cz), (xx, xy, xz, yy, yz, zz)


def _significant(values: Iterable[Fraction | float]) -> list[float]:
    """Return values rounded to `inertia_digits` significant digits."""
    # Adding 0.0 changes -0.0 to 0.0.
    return [rounded(float(value), TUNING.inertia_digits) + 0.0 for value in values]


def _triple(values: Vector) -> Triple:
    x, y, z = map(float, values)
    return x, y, z
