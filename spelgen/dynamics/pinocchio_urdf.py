"""A URDF -> its rigid-body dynamics as Pinocchio reads the file, by itself: a second reading beside spelgen's own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pinocchio as pin

from spelgen.arm.actuation import derive_actuation
from spelgen.dynamics.constraint import mimic_constraint
from spelgen.dynamics.pinocchio_dynamics import PinocchioDynamics
from spelgen.settings.settings import load_settings
from spelgen.urdf.read import read_urdf

COULOMB_SMOOTHING_VELOCITY = (
    0.05  # [rad/s, m/s] width of the tanh in place of the jump of a URDF's Coulomb friction
)


def urdf_dynamics(urdf: Path, joints: Sequence[str]) -> PinocchioDynamics:
    """The dynamics of these joints of a URDF and what follows them, all others locked at zero.

    Inertials, damping and friction are the URDF's; gravity and inputs the settings' beside it. Raises what
    Pinocchio raises where it cannot read the file.
    """
    robot, settings = read_urdf(urdf), load_settings(urdf)
    model = pin.buildModelFromUrdf(str(urdf))
    model.gravity.linear = np.array(settings.gravity)
    constraint = mimic_constraint(robot, joints)
    missing = [name for name in constraint.names if not model.existJointName(name)]
    if missing:
        raise ValueError(f"Pinocchio sees no joint {', '.join(missing)}")
    damping, coulomb = (
        np.array([getattr(robot.joint[name], what) for name in joints]) for what in ("damping", "friction")
    )

    def friction(qd: np.ndarray) -> np.ndarray:
        lost: np.ndarray = damping * qd + coulomb * np.tanh(qd / COULOMB_SMOOTHING_VELOCITY)
        return lost

    inputs = derive_actuation(robot, settings, joints).matrix()
    return PinocchioDynamics(model, constraint, friction, inputs)
