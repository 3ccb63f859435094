"""Structure and nominal sizes -> ModelSpec: the decisions that the emitted module then merely spells out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import isfinite

import numpy as np

from spelgen.arm.actuation import Actuation
from spelgen.arm.arm import Arm, Coordinate
from spelgen.design import Design, load_design
from spelgen.emission.entry_sums import mean_mass
from spelgen.emission.links import link_specs
from spelgen.emission.tuning import TUNING
from spelgen.errors import SettingsError
from spelgen.settings.joint import JointSettings
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
)
from spelgen.structure.basis import Weights
from spelgen.structure.nominal import Nominal, exact_inertias, nominal, working_range
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
    design = load_design(options.design or options.preset)
    if servos and design.memory == "none":
        raise SettingsError(
            f"position servos with the preset {options.preset}", element="input",
            expected="a preset with bristle friction, which position servos need", do="--preset closed-form",
        )  # fmt: skip
    everything = tuple(range(len(arm.coordinates)))
    sizes = nominal(arm, structure)
    joints, servo_specs = [], []
    for index, coordinate in enumerate(arm.coordinates):
        drive = (drives or {}).get(coordinate.name, JointSettings())
        joints.append(_joint(coordinate, sizes, index, drive))
        if servos:
            servo_specs.append(_servo(coordinate, drive))
    inputs = []
    if design.input == "derived" and not (actuation.direct and len(actuation.entries) == len(joints)):
        for entry in actuation.entries:
            inputs.append(InputSpec(entry.row, entry.column, entry.value, entry.kind == "gain"))
    links: tuple[LinkSpec, ...] = ()
    outputs, constants = _outputs(structure, sizes, design), _constants(structure, sizes)
    if design.mass == "closed-form":
        links = link_specs(arm, exact_inertias(arm, sizes.from_urdf))
        joints = _with_armature(joints, np.diagonal(mean_mass(len(joints), outputs, constants)))
    potential = structure.potential
    if design.potential == "dense":
        potential = everything
    x, y, z = map(float, arm.gravity)
    return ModelSpec(
        robot=arm.name,
        urdf=urdf,
        urdf_sha256=urdf_sha256,
        gravity=(x, y, z),
        options=options,
        design=design,
        joints=tuple(joints),
        entries=tuple((e.row, e.column, e.kind, e.joints) for e in structure.entries),
        outputs=outputs,
        constants=constants,
        potential=potential,
        potential_scale=sizes.potential_scale,
        margin=float(f"{max(TUNING.margin * sizes.least_eigenvalue, 1e-4):.0e}"),
        started_from_urdf=sizes.from_urdf,
        links=links,
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


def _joint(coordinate: Coordinate, sizes: Nominal, index: int, drive: JointSettings) -> JointSpec:
    low, high = working_range(coordinate)
    lower, upper, speed = coordinate.lower, coordinate.upper, coordinate.velocity
    if coordinate.continuous:
        lower = upper = None
    lower, upper = (None if x is None or not isfinite(x) else float(f"{x:.6g}") for x in (lower, upper))
    if not speed or speed > TUNING.largest_speed:
        speed = TUNING.usual_turning if coordinate.kind == "revolute" else TUNING.usual_sliding
    return JointSpec(
        name=coordinate.name,
        joint_type=coordinate.kind,
        lower=lower,
        upper=upper,
        center=float(f"{(low + high) / 2:.6g}"),
        half_range=float(f"{(high - low) / 2:.6g}"),
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


def _with_armature(joints: Sequence[JointSpec], mass: np.ndarray) -> list[JointSpec]:
    """Return the joints with a small armature for drives without data, from the diagonal of M (n,)."""
    initial = [float(f"{TUNING.least_armature * value:.3g}") for value in mass]
    return [replace(x, armature=x.armature or least) for x, least in zip(joints, initial, strict=True)]


def _floats(weights: Weights) -> Entries:
    return tuple((row, column, float(value)) for row, column, value in weights)
