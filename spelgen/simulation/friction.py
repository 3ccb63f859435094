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
    losses = []
    for coordinate in arm.coordinates:
        joint = _losses(coordinate, settings)
        losses.append((joint.viscous, *joint.coulomb))
    viscous, forward, backward = np.array(losses).T
    return Friction(
        viscous=viscous,
        forward=forward,
        backward=backward,
        smoothing_velocity=settings.simulation.coulomb_smoothing_velocity,
        speeds=None if speeds is None or np.array_equal(speeds, np.eye(len(speeds))) else speeds,
    )


def _losses(coordinate: Coordinate, settings: Settings) -> JointSettings:
    urdf = JointSettings(viscous=coordinate.damping, coulomb=(coordinate.friction, -coordinate.friction))
    return settings.joints.get(coordinate.name, urdf)
