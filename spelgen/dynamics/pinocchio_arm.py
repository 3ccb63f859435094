"""Pinocchio model of a `Chain` (the bodies of an arm, not its URDF file), with rotor inertia from the settings file."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pinocchio as pin

from spelgen.arm.arm import Chain
from spelgen.dynamics.pinocchio_dynamics import PinocchioDynamics
from spelgen.dynamics.tip_frame import body_constraint
from spelgen.errors import ArmError, collect
from spelgen.settings.settings import Settings


def arm_dynamics(
    arm: Chain, settings: Settings, friction: Callable[[np.ndarray], np.ndarray] | None = None
) -> PinocchioDynamics:
    """Return the dynamics of the arm with joint torques as inputs. Raises ArmError if a body has no <inertial>.

    friction: function of qd, (..., n) [rad/s, m/s], that returns the friction torque, (..., n) [Nm, N]; None: no
    friction.
    """
    return PinocchioDynamics(pinocchio_model(arm, settings), body_constraint(arm), friction)


def require_inertials(arm: Chain, file: Path | None = None) -> None:
    """Raise ArmError if a body has no <inertial>, or negative mass, for which Pinocchio returns meaningless numbers.

    file: the URDF, for the error.
    """
    error = partial(
        ArmError,
        file=file,
        expected="mass, center of mass and inertia of each moving body",
        do="write estimates into the URDF; a model that is trained on logs needs none",
    )
    mass = {body.name: float(body.inertia[0]) if body.inertia else None for body in arm.bodies}
    faults = {x: "a link without <inertial>" if m is None else f"a body of {m:g} kg" for x, m in mass.items()}
    collect([error(faults[x], element=f"joint {x!r}") for x, m in mass.items() if m is None or m < 0])


def pinocchio_model(arm: Chain, settings: Settings) -> pin.Model:
    """Return a Pinocchio model of the arm's bodies, with one joint per body, inertia and armature.

    The armature is the rotor inertia on the joint side. Raises ArmError, see `require_inertials`.
    """
    require_inertials(arm)
    model = kinematic_model(arm)
    # The joint with index 0 is the universe (the fixed world) in Pinocchio, so bodies are counted from 1.
    for index, body in enumerate(arm.bodies, start=1):
        model.appendBodyToJoint(index, _inertia(np.array(body.inertia, dtype=float)), pin.SE3.Identity())
    # A mimic joint has no motor of its own, and therefore no armature.
    rotors = {name: settings.joint(name).armature for name in arm.joint_names}
    model.armature = np.array([rotors.get(body.name, 0.0) for body in arm.bodies])
    return model


def kinematic_model(arm: Chain) -> pin.Model:
    """Return a Pinocchio model with one joint per body of the arm, in the same order, without inertia.

    It is sufficient for kinematics. A joint rotates about or translates along the z axis of its frame.
    """
    model = pin.Model()
    model.name = arm.name
    model.gravity.linear = np.array(arm.gravity, dtype=float)
    for body in arm.bodies:
        # The axis of each joint is the z axis of the body's frame: two joint types of Pinocchio are enough.
        joint = pin.JointModelPZ() if body.joint_type == "prismatic" else pin.JointModelRZ()
        placement = pin.SE3(np.array(body.rotation, dtype=float), np.array(body.translation, dtype=float))
        model.addJoint(body.parent + 1, joint, placement, body.name)
    return model


def _inertia(parameters: np.ndarray) -> pin.Inertia:
    mass, hx, hy, hz, ixx, ixy, ixz, iyy, iyz, izz = parameters
    if mass == 0.0:  # `FromDynamicParameters` would divide by zero.
        return pin.Inertia(0.0, np.zeros(3), np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]]))
    return pin.Inertia.FromDynamicParameters(np.array([mass, hx, hy, hz, ixx, ixy, iyy, ixz, iyz, izz]))
