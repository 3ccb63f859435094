"""Structure and nominal sizes -> ModelSpec: the decisions that the emitted module then merely spells out."""

from __future__ import annotations

import keyword
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from spelgen.arm.actuation import Actuation
from spelgen.arm.arm import Arm, Coordinate
from spelgen.design import Design, load_design
from spelgen.emission.bodies import body_specs
from spelgen.emission.tuning import TUNING
from spelgen.errors import SettingsError
from spelgen.settings.joint import JointSettings
from spelgen.spec import BodySpec, ConstantSpec, Entries, JointSpec, ModelSpec, Options, OutputSpec, ServoSpec
from spelgen.structure.basis import Weights
from spelgen.structure.nominal import Nominal, nominal, nominal_inertias, working_range
from spelgen.structure.structure import Structure


def plan_model(
    arm: Arm,
    structure: Structure,
    actuation: Actuation,
    options: Options,
    *,
    urdf: str,
    urdf_sha256: str,
    drives: Mapping[str, JointSettings] | None = None,
    servos: bool = False,
) -> ModelSpec:
    """The model of ``arm`` under ``options``; ``urdf`` is the file's name without its folder.

    ``drives``: what is known of the joints' motors and gears; where no rotor inertia is, one is guessed.
    ``servos``: whether positions are commanded. Raises SettingsError where the design has no friction that remembers.
    """
    design = load_design(options.design or options.preset, options.net)
    if servos and design.memory == "none":
        raise SettingsError(
            f"position servos with the preset {options.preset}", element="input",
            expected="a preset with bristle friction, which position servos need", do="--preset closed-form",
        )  # fmt: skip
    everything = tuple(range(len(arm.coordinates)))
    sizes = nominal(arm, structure)
    identifiers = _identifiers(arm.joint_names)
    joints, servo_specs = [], []
    for index, coordinate in enumerate(arm.coordinates):
        drive = (drives or {}).get(coordinate.name, JointSettings())
        joints.append(_joint(coordinate, identifiers[index], sizes, index, drive))
        if servos:
            servo_specs.append(_servo(coordinate, drive))
    inputs = []
    if design.input == "derived" and not (actuation.direct and len(actuation.entries) == len(joints)):
        for entry in actuation.entries:
            inputs.append((entry.row, entry.column, entry.value, entry.kind == "gain"))
    bodies: tuple[BodySpec, ...] = ()
    if design.mass == "closed-form":
        bodies = body_specs(arm, nominal_inertias(arm, sizes.from_urdf))
    potential = structure.potential
    if design.potential == "dense":
        potential = everything
    x, y, z = map(float, arm.gravity)
    return ModelSpec(
        robot=arm.name,
        urdf=urdf,
        urdf_sha256=urdf_sha256,
        gravity=(x, y, z),
        options=replace(options, net=None if design.net == "none" else design.net),
        design=design,
        joints=tuple(joints),
        entries=tuple((e.row, e.column, e.kind, e.joints) for e in structure.entries),
        outputs=_outputs(structure, sizes, design),
        constants=_constants(structure, sizes),
        potential=potential,
        potential_scale=sizes.potential_scale,
        margin=float(f"{max(TUNING.margin * sizes.least_eigenvalue, 1e-4):.0e}"),
        started_from_urdf=sizes.from_urdf,
        bodies=bodies,
        inputs=tuple(inputs),
        motor_speeds=_motor_speeds(actuation),
        servos=tuple(servo_specs),
    )


def _outputs(structure: Structure, sizes: Nominal, design: Design) -> tuple[OutputSpec, ...]:
    """The functions of M, each with the joints that it reads, its mean and its scale."""
    outputs = []
    for output, mean, scale in zip(structure.outputs, sizes.output_means, sizes.output_scales, strict=True):
        joints = output.joints
        if design.encoding == "lie-group":
            joints = tuple(range(len(sizes.mass_sensitivities)))
        outputs.append(OutputSpec(joints, _floats(output.basis), mean, scale))
    return tuple(outputs)


def _constants(structure: Structure, sizes: Nominal) -> tuple[ConstantSpec, ...]:
    """The constants of M, each with its start and its unit."""
    constants = []
    for constant, start, scale in zip(
        structure.constants, sizes.constants, sizes.constant_scales, strict=True
    ):
        constants.append(ConstantSpec(_floats(constant.basis), start, scale))
    return tuple(constants)


def _motor_speeds(actuation: Actuation) -> tuple[tuple[float, ...], ...]:
    """Return C, by which motors' speeds are C qd; empty where each motor moves its own joint alone."""
    speeds = actuation.drives().speeds
    if np.array_equal(speeds, np.eye(actuation.joints)):
        return ()
    return tuple(map(tuple, speeds.tolist()))


def _joint(
    coordinate: Coordinate, identifier: str, sizes: Nominal, index: int, drive: JointSettings
) -> JointSpec:
    low, high = working_range(coordinate)
    lower, upper, speed = coordinate.lower, coordinate.upper, coordinate.velocity
    if coordinate.continuous:
        lower = upper = None
    if not speed or speed > TUNING.largest_speed:
        speed = TUNING.usual_turning if coordinate.kind == "revolute" else TUNING.usual_sliding
    return JointSpec(
        name=coordinate.name,
        identifier=identifier,
        kind=coordinate.kind,
        lower=lower,
        upper=upper,
        center=float(f"{(low + high) / 2:.6g}"),
        reach=float(f"{(high - low) / 2:.6g}"),
        speed=speed,
        friction=float(f"{_friction(coordinate, sizes, index):.3g}"),
        armature=float(f"{drive.armature or _guessed_armature(coordinate):.3g}"),
        gear=drive.gear,
        mass_sensitivity=sizes.mass_sensitivities[index],
        potential_sensitivity=sizes.potential_sensitivities[index],
    )


def _servo(coordinate: Coordinate, drive: JointSettings) -> ServoSpec:
    """The servo of a joint: one that nothing is known of gives its full effort half a unit from its command."""
    effort = coordinate.effort
    if not effort or effort > TUNING.largest_effort:
        effort = None
    kp = drive.kp or float(f"{(effort or TUNING.servo_effort) / TUNING.full_effort_at:.3g}")
    return ServoSpec(kp, drive.kp is not None, float(f"{TUNING.servo_lag * kp:.3g}"), effort)


def _guessed_armature(coordinate: Coordinate) -> float:
    """Return a geared drive's own inertia: its full effort takes ``rise`` seconds to its full speed."""
    effort, speed = coordinate.effort, coordinate.velocity
    if not effort or not speed or effort > TUNING.largest_effort or speed > TUNING.largest_speed:
        return 0.0
    return TUNING.rise * effort / speed


def _friction(coordinate: Coordinate, sizes: Nominal, index: int) -> float:
    """Return the size of friction to start from [Nm, N].

    It is a share of the drive's effort where the URDF names a plausible one, or of the torques that the nominal arm
    needs.
    """
    if coordinate.effort and coordinate.effort <= TUNING.largest_effort:
        return TUNING.friction_of_effort * coordinate.effort
    # a wrist may need next to no torque by itself, but its gear rubs like its neighbour's
    return TUNING.friction_of_torque * max(sizes.joint_torque[index], 0.01 * max(sizes.joint_torque))


def _identifiers(names: Sequence[str]) -> list[str]:
    """Unique ASCII identifiers, recognisable where the name allows it."""
    used: set[str] = set()
    identifiers = []
    for index, name in enumerate(names, start=1):
        plain = re.sub(r"[^0-9a-z]+", "_", name.lower()).strip("_")[:40]
        if not plain or keyword.iskeyword(plain) or keyword.issoftkeyword(plain) or plain[0].isdigit():
            plain = f"joint_{plain or index}"
        unique, count = plain, 2
        while unique in used:
            unique, count = f"{plain}_{count}", count + 1
        used.add(unique)
        identifiers.append(unique)
    return identifiers


def _floats(weights: Weights) -> Entries:
    return tuple((row, column, float(value)) for row, column, value in weights)
