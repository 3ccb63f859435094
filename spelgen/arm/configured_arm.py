"""An arm from its URDF and its settings."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spelgen.arm.actuation import Actuation, derive_actuation
from spelgen.arm.arm import Chain, make_arm
from spelgen.errors import Diagnostic
from spelgen.labels import counted
from spelgen.settings.settings import Settings, load_settings
from spelgen.urdf.read import read_urdf
from spelgen.urdf.robot import Robot


@dataclass(frozen=True, repr=False)
class Arm:
    """An arm: the robot of a URDF, its settings, the serial chain, and the input matrix of the motors.

    ``joints``, ``tip`` and ``angle_tolerance`` are the arguments of ``load_arm`` with which the chain was chosen.
    """

    robot: Robot
    settings: Settings
    chain: Chain
    actuation: Actuation
    joints: tuple[str, ...] | None
    tip: str | None
    angle_tolerance: float

    @property
    def diagnostics(self) -> tuple[Diagnostic, ...]:
        """Diagnostics of the URDF, the chain, the input matrix and the settings, in this order."""
        sources = (self.robot, self.chain, self.actuation, self.settings)
        return tuple(item for source in sources for item in source.diagnostics)

    @property
    def turning_joints(self) -> tuple[str, ...]:
        """Names of the revolute joints without position limits, or with limits that are more than two turns apart."""
        revolute = [x for x in self.chain.coordinates if x.joint_type == "revolute"]
        # limits such as 6.2832 are rounded turns
        return tuple(x.name for x in revolute if x.limits is None or np.ptp(x.limits) > 4.04 * np.pi)

    def __repr__(self) -> str:
        joints = counted(len(self.chain.coordinates), "joint")
        return f"<Arm {self.chain.name!r}: {joints} of {self.robot.path.name}>"


def load_arm(
    path: str | Path,
    joints: Sequence[str] | None = None,
    tip: str | None = None,
    angle_tolerance: float = 2e-3,
) -> Arm:
    """Return the arm in the URDF at ``path``, with the settings in the YAML file of the same name.

    Args:
        path: URDF or xacro file.
        joints: names of the moving joints. Without ``joints`` and ``tip`` the settings specify the chain, or the
            longest serial chain is used.
        tip: name of the last link of the chain, in place of ``joints``.
        angle_tolerance: angles [rad] that differ from a multiple of pi/2 by at most this tolerance are rounded to the
            multiple; 0: no angle is rounded.

    Raises UrdfError, ArmError or SettingsError.
    """
    path = Path(path)
    robot = read_urdf(path)
    settings = load_settings(path, robot.joint)
    if joints is None and tip is None:
        joints, tip = settings.moving_joints, settings.tip
    passive = [name for name in robot.joint if not settings.joint(name).actuated]
    gravity = settings.gravity
    arm = make_arm(
        robot, joints=joints, tip=tip, angle_tolerance=angle_tolerance, gravity=gravity, passive=passive
    )
    return Arm(
        robot=robot,
        settings=settings,
        chain=arm,
        actuation=derive_actuation(robot, settings, arm.joint_names),
        joints=None if joints is None else tuple(joints),
        tip=tip,
        angle_tolerance=angle_tolerance,
    )


def urdf_path(arm: Arm | Path | str | None) -> Path | None:
    """Return the path of the URDF of a loaded arm, or the given path; None without an arm."""
    if arm is None:
        return None
    return Path(arm) if isinstance(arm, str | Path) else arm.robot.path
