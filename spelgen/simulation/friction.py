"""Take the friction of simulated joints from the settings, else from the URDF."""

from __future__ import annotations

import numpy as np

from spelgen.arm.arm import Arm, Coordinate
from spelgen.dynamics.joint_friction import Friction
from spelgen.settings.joint import JointSettings
from spelgen.settings.settings import Settings


def make_friction(arm: Arm, settings: Settings, speeds: np.ndarray | None = None) -> Friction:
    """Return the friction of the arm: a joint's settings where it has some, else its URDF's <dynamics>.

    speeds: C (n, n) of the drives. Where they move several joints, a joint's friction is that of its drive, as in the
    models.
    """
    joints = [_losses(coordinate, settings) for coordinate in arm.coordinates]
    return Friction(
        viscous=np.array([joint.viscous for joint in joints]),
        forward=np.array([joint.coulomb[0] for joint in joints]),
        backward=np.array([joint.coulomb[1] for joint in joints]),
        smoothing_velocity=settings.simulation.coulomb_smoothing_velocity,
        speeds=None if speeds is None or np.array_equal(speeds, np.eye(len(speeds))) else speeds,
    )


def _losses(coordinate: Coordinate, settings: Settings) -> JointSettings:
    urdf = JointSettings(viscous=coordinate.damping, coulomb=(coordinate.friction, -coordinate.friction))
    return settings.joints.get(coordinate.name, urdf)
