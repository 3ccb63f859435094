"""A URDF -> its rigid-body dynamics as Pinocchio reads the file, by itself: a second reading beside spelgen's own."""

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

# [rad/s, m/s] width of the tanh in place of the jump of a URDF's Coulomb friction
COULOMB_SMOOTHING_VELOCITY = 0.05


def urdf_dynamics(urdf: Path, joints: Sequence[str], *, drives: bool = False) -> PinocchioDynamics:
    """The dynamics of these joints of a URDF and what follows them, all others locked at zero.

    Inertials, damping and friction are the URDF's; gravity and inputs the settings' beside it. drives: with the
    settings' rotors, and their friction in place of the URDF's where a joint has any. Raises what Pinocchio raises
    where it cannot read the file.
    """
    robot, settings = read_urdf(urdf), load_settings(urdf)
    model = pin.buildModelFromXML(urdf_bytes(urdf).decode(errors="replace"))
    model.gravity.linear = np.array(settings.gravity)
    constraint = mimic_constraint(robot, joints)
    missing = [name for name in constraint.names if not model.existJointName(name)]
    if missing:
        raise ValueError(f"Pinocchio sees no joint {', '.join(missing)}")
    motors = derive_actuation(robot, settings, joints).drives()
    by_joint, speeds = {}, None  # a file's own friction is the joints', that of drives the motors'
    if drives:
        by_joint, speeds = settings.joints, motors.speeds
    for name in joints:
        if name in by_joint:
            model.armature[model.joints[model.getJointId(name)].idx_v] = by_joint[name].armature
    moving = [robot.joint[name] for name in joints]
    friction = joint_friction(moving, by_joint, COULOMB_SMOOTHING_VELOCITY, speeds)
    return PinocchioDynamics(model, constraint, friction, motors.inputs)


def has_drives(urdf: Path, joints: Sequence[str]) -> bool:
    """Whether the settings beside a URDF tell of rotors or friction of these joints."""
    drives = load_settings(urdf).joints
    return any(x.rotor_inertia or x.viscous or any(x.coulomb) for k, x in drives.items() if k in joints)
