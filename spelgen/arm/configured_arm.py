"""An arm as its URDF and its sidecar give it, for steps that derive nothing from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

from spelgen.arm.actuation import Actuation, derive_actuation
from spelgen.arm.arm import Arm, make_arm
from spelgen.settings.settings import Settings, load_settings
from spelgen.urdf.read import read_urdf
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

    @classmethod
    def load(
        cls,
        path: str | Path,
        joints: Sequence[str] | None = None,
        tip: str | None = None,
        angle_tolerance: float = 2e-3,
    ) -> Self:
        """Read a URDF and its sidecar, and take the arm from it; see ``load_arm``."""
        path = Path(path)
        robot = read_urdf(path)
        settings = load_settings(path, robot.joint)
        if joints is None and tip is None:
            joints, tip = settings.moving_joints, settings.tip
        arm = make_arm(
            robot, joints=joints, tip=tip, angle_tolerance=angle_tolerance, gravity=settings.gravity
        )
        coordinates = tuple(
            replace(coordinate, passive=not settings.joint(coordinate.name).actuated)
            for coordinate in arm.coordinates
        )
        return cls(
            robot=robot,
            settings=settings,
            arm=replace(arm, coordinates=coordinates),
            actuation=derive_actuation(robot, settings, arm.joint_names),
            joints=None if joints is None else tuple(joints),
            tip=tip,
            angle_tolerance=angle_tolerance,
        )
