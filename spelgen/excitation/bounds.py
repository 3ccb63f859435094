"""Bounds of a motion: bounds of the joints, and the surroundings of an arm (floor and boxes) from a YAML file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import nan, pi
from pathlib import Path

import numpy as np
from pydantic import Field, field_validator

from spelgen.arm.arm import Chain
from spelgen.errors import ArmError, collect
from spelgen.excitation.tuning import TUNING
from spelgen.settings.yaml_document import Group, Number, Positive, read_document, validated
from spelgen.urdf.robot import UrdfJoint

SPEEDS = {"revolute": TUNING.revolute_speed, "prismatic": TUNING.prismatic_speed}
"""Speed limits of joints without a velocity limit [rad/s], [m/s]."""


@dataclass(frozen=True, eq=False)
class MotionBounds:
    """Bounds of the motion of n joints, (n,) each.

    low, high: lowest and highest position [rad, m]. speed: largest speed [rad/s, m/s]. acceleration: largest
    acceleration [rad/s^2, m/s^2]; None: unlimited.
    """

    low: np.ndarray
    high: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray | None = None

    def narrowed(self, factor: float) -> MotionBounds:
        """Return bounds whose position ranges are multiplied by a factor, with unchanged middles."""
        middle, half = (self.low + self.high) / 2, factor * (self.high - self.low) / 2
        return replace(self, low=middle - half, high=middle + half)


def motion_bounds(
    arm: Chain,
    range_fraction: float,
    speed_fraction: float,
    joints: Mapping[str, UrdfJoint] | None = None,
    ranges: Mapping[str, tuple[float, float]] | None = None,
) -> MotionBounds:
    """Return bounds that are fractions of the position ranges and of the velocity limits.

    Args:
        arm: The arm.
        range_fraction: Fraction of each position range; the middle of the range is unchanged.
        speed_fraction: Fraction of each velocity limit.
        joints: {name: joint of the URDF}. The bounds are then reduced to the soft limits of <safety_controller>, and so
            that <mimic> joints keep their limits, too. None: limits of mimic joints and soft limits are ignored.
        ranges: {name of a joint: position range}, in place of the limits in the URDF. A continuous joint without a
            range has the range -pi to pi.

    Raises ArmError for a joint without a range, or with limits that are not increasing.
    """
    limits, speeds = np.zeros((len(arm.coordinates), 2)), np.zeros(len(arm.coordinates))
    for k, coordinate in enumerate(arm.coordinates):
        default = (-pi, pi) if coordinate.continuous else (nan, nan)
        soft = joints[coordinate.name].safe_limits if joints else None
        limits[k] = sorted((ranges or {}).get(coordinate.name) or soft or coordinate.limits or default)
        speeds[k] = coordinate.velocity or SPEEDS[coordinate.joint_type]
    # The position of a mimic joint is a linear function of the position of its driving joint. The range of the driving
    # joint is narrowed until both joints keep their limits.
    for body in arm.bodies:
        k, factor = body.coordinate, float(body.multiplier)
        mimic = (joints or {}).get(body.name)
        if mimic is None or body.name == arm.coordinates[k].name or not factor:
            continue
        if mimic.safe_limits is not None:
            low, high = sorted((end - body.offset) / factor for end in mimic.safe_limits)
            limits[k] = max(low, limits[k, 0]), min(high, limits[k, 1])
        if mimic.velocity:
            speeds[k] = min(speeds[k], mimic.velocity / abs(factor))
    errors = []
    for coordinate, (low, high) in zip(arm.coordinates, limits, strict=True):
        if not low < high:
            errors.append(range_error(coordinate.name, None if np.isnan(low) else (low, high)))
    collect(errors)
    return MotionBounds(limits[:, 0], limits[:, 1], speed_fraction * speeds).narrowed(range_fraction)


def range_error(joint: str, limits: tuple[float, float] | None) -> ArmError:
    """Return the error for a joint whose limits are absent or not increasing; limits: [rad, m], None if absent."""
    got = "no position limits"
    do = f"write 'simulation: {{positions: {{{joint}: [LOWEST, HIGHEST]}}}}' into the robot's YAML"
    if limits is not None:
        got = f"the limits {limits[0]:g} .. {limits[1]:g}"
        do = f"correct them, omit the joint by --joints, or {do}"
    return ArmError(got, element=f"joint {joint!r}", expected="a range to move in", do=do)


class Box(Group):
    """A box. size: edge lengths [m]. xyz [m], rpy [rad]: pose of the centre in the root link's frame, as in a URDF."""

    size: tuple[Positive, Positive, Positive]
    xyz: tuple[Number, Number, Number] = (0.0, 0.0, 0.0)
    rpy: tuple[Number, Number, Number] = (0.0, 0.0, 0.0)


class Surroundings(Group):
    """The surroundings of an arm, in the frame of its root link.

    Attributes:
        floor: Height z of the floor [m]; None: there is no floor.
        boxes: Boxes by name.
        clearance: Smallest allowed distance between links, and from links to floor and boxes [m].
    """

    floor: Number | None = None
    boxes: dict[str, Box] = Field(default_factory=dict)
    clearance: Positive = 0.01

    @field_validator("boxes", mode="before")
    @classmethod
    def _by_name(cls, boxes: object) -> object:
        if isinstance(boxes, list):
            raise ValueError("boxes by name, as in {table: {size: [1, 1, 0.1], xyz: [0, 0, -0.05]}}")
        return boxes


def read_surroundings(path: Path) -> Surroundings:
    """Return the surroundings in a YAML file. Raises SettingsError, or SpelgenErrors for several errors."""
    document = read_document(path)
    return validated(Surroundings, document.value(), document)
