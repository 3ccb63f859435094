"""An arm as its URDF and its sidecar give it, for steps that derive nothing from it."""

from __future__ import annotations

from dataclasses import dataclass

from spelgen.arm.actuation import Actuation
from spelgen.arm.arm import Arm
from spelgen.settings.settings import Settings
from spelgen.urdf.robot import Robot


@dataclass(frozen=True, repr=False)
class ConfiguredArm:
    """The robot of a URDF as read, its sidecar's settings, the arm taken from them, and its inputs.

    ``joints``, ``tip`` and ``angle_tolerance`` are those that ``load_arm`` was given.
    """

    robot: Robot
    settings: Settings
    arm: Arm
    actuation: Actuation
    joints: tuple[str, ...] | None
    tip: str | None
    angle_tolerance: float
