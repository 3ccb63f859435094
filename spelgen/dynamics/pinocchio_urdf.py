"""Rigid-body dynamics of a URDF as Pinocchio reads it: independent of the reader of this package."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pinocchio as pin

from spelgen.arm.actuation import derive_actuation
from spelgen.dynamics.constraint import mimic_constraint
from spelgen.dynamics.joint_friction import joint_friction
from spelgen.dynamics.pinocchio_dynamics import PinocchioDynamics
from spelgen.settings.settings import load_settings
from spelgen.urdf.document import urdf_bytes
from spelgen.urdf.read import read_urdf

# Width of the tanh in place of the sign of the velocity, for Coulomb friction of a URDF [rad/s, m/s].
COULOMB_SMOOTHING_VELOCITY = 0.05


def urdf_dynamics(urdf: Path, joints: Sequence[str], *, drives: bool = False) -> PinocchioDynamics:
    """Return the dynamics of these joints of a URDF and of their mimic joints; all other joints are locked at zero.

    Inertials, damping and friction are those of the URDF; gravity and inputs those of the settings. drives: with rotors
    of the settings, and their friction, if there is any, in place of that of the URDF. Raises the errors of Pinocchio
    if it cannot read the file.
    """
    robot, settings = read_urdf(urdf), load_settings(urdf)
    model = pin.buildModelFromXML(urdf_bytes(urdf).decode(errors="replace"))
    model.gravity.linear = np.array(settings.gravity)
    constraint = mimic_constraint(robot, joints)
    missing = [name for name in constraint.names if not model.existJointName(name)]
    if missing:
        raise ValueError(f"Pinocchio sees no joint {', '.join(missing)}")
    motors = derive_actuation(robot, settings, joints).drives()
    by_joint, speeds = (
        {},
        None,
    )  # friction of the URDF acts at the joints, friction of the settings at the motors
    if drives:
        by_joint, speeds = settings.joints, motors.speeds
    for name in joints:
        if name in by_joint:
            model.armature[model.joints[model.getJointId(name)].idx_v] = by_joint[name].armature
    moving = [robot.joint[name] for name in joints]
    friction = joint_friction(moving, by_joint, COULOMB_SMOOTHING_VELOCITY, speeds)
    return PinocchioDynamics(model, constraint, friction, motors.inputs)


def drives_known(urdf: Path, joints: Sequence[str]) -> bool:
    """Return whether the settings of a URDF specify rotors or friction of these joints."""
    drives = load_settings(urdf).joints
    return any(x.rotor_inertia or x.viscous or any(x.coulomb) for k, x in drives.items() if k in joints)
