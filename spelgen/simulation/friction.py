"""Take the friction of simulated joints from the settings, else from the URDF."""

from __future__ import annotations

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.dynamics.joint_friction import Friction, joint_friction
from spelgen.settings.settings import Settings


def make_friction(arm: Arm, settings: Settings, speeds: np.ndarray | None = None) -> Friction:
    """Return the friction of the arm: a joint's settings where it has some, else its URDF's <dynamics>.

    speeds: C (n, n) of the drives. Where they move several joints, a joint's friction is that of its drive, as in the
    models.
    """
    width = settings.simulation.coulomb_smoothing_velocity
    return joint_friction(arm.coordinates, settings.joints, width, speeds)
