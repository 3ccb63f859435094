"""Arm + Settings -> rigid-body dynamics by Pinocchio, reflected rotor inertia included, friction not.

    M(q) qdd + bias(q, qd) = tau        with  M = K^T (M_bodies + diag(gear^2 rotor_inertia)) K

where the joints of the bodies are at K q + offset. K is constant, so it adds no velocity terms; it is the
identity unless mimic joints share a coordinate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from spelgen.arm.arm import Arm
from spelgen.errors import ArmError, collect
from spelgen.settings.settings import Settings


@dataclass(frozen=True, eq=False)
class Engine:
    """An arm of n coordinates and b bodies; the model has one joint for each body.

    jacobian: K, (b, n). offset: (b,). direct: bodies and coordinates are the same.
    """

    model: pin.Model
    data: pin.Data
    jacobian: np.ndarray
    offset: np.ndarray
    direct: bool


def make_engine(arm: Arm, settings: Settings) -> Engine:
    """Return the arm ready for the functions below; raises ArmError when a body has no inertial."""
    model = pinocchio_model(arm, settings)
    jacobian = np.zeros((len(arm.bodies), len(arm.coordinates)))
    for row, body in enumerate(arm.bodies):
        jacobian[row, body.coordinate] = float(body.multiplier)
    offset = np.array([body.offset for body in arm.bodies], dtype=float)
    direct = not offset.any() and np.array_equal(jacobian, np.eye(*jacobian.shape))
    return Engine(model, model.createData(), jacobian, offset, direct)


def mass_matrix(engine: Engine, q: np.ndarray) -> np.ndarray:
    """Return M(q), (n, n), rotors included, at q (n,) [rad; m]."""
    upper = np.triu(pin.crba(engine.model, engine.data, engine.jacobian @ q + engine.offset))
    bodies = upper + np.triu(upper, 1).T  # Pinocchio promises the upper triangle only
    return engine.jacobian.T @ bodies @ engine.jacobian


def bias(engine: Engine, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Return the Coriolis, centrifugal and gravity torques (n,) [Nm; N] at q and qd (n,)."""
    positions, velocities = engine.jacobian @ q + engine.offset, engine.jacobian @ qd
    return engine.jacobian.T @ pin.nle(engine.model, engine.data, positions, velocities)


def forward_dynamics(engine: Engine, q: np.ndarray, qd: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Return qdd (n,) at q and qd (n,) under the torques tau (n,) that are left after friction."""
    if engine.direct:
        return pin.aba(engine.model, engine.data, q, qd, tau).copy()  # else a view of engine.data
    return np.linalg.solve(mass_matrix(engine, q), tau - bias(engine, q, qd))


def pinocchio_model(arm: Arm, settings: Settings) -> pin.Model:
    """Return a model with, for each body in its order, a joint about or along its own z.

    Reflected rotor inertia is the model's armature. Raises ArmError when a body has no inertial.
    """
    bare = [body.name for body in arm.bodies if body.inertia is None]
    collect([ArmError("its link has no inertial", element=f"joint {name!r}") for name in bare])
    model = pin.Model()
    model.name = arm.name
    model.gravity.linear = np.array(arm.gravity, dtype=float)
    for body in arm.bodies:
        joint = pin.JointModelPZ() if body.kind == "prismatic" else pin.JointModelRZ()
        placement = pin.SE3(np.array(body.rotation, dtype=float), np.array(body.translation, dtype=float))
        index = model.addJoint(body.parent + 1, joint, placement, body.name)
        model.appendBodyToJoint(index, _inertia(np.array(body.inertia, dtype=float)), pin.SE3.Identity())
    model.armature = np.array([_reflected_inertia(arm, settings, body.name) for body in arm.bodies])
    return model


def _reflected_inertia(arm: Arm, settings: Settings, joint_name: str) -> float:
    if joint_name not in {coordinate.name for coordinate in arm.coordinates}:
        return 0.0  # a mimic joint has no motor of its own
    joint = settings.joint(joint_name)
    return joint.rotor_inertia * joint.gear**2


def _inertia(parameters: np.ndarray) -> pin.Inertia:
    mass, hx, hy, hz, ixx, ixy, ixz, iyy, iyz, izz = parameters
    if mass == 0.0:  # Pinocchio would divide by it
        return pin.Inertia(0.0, np.zeros(3), np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]]))
    return pin.Inertia.FromDynamicParameters(np.array([mass, hx, hy, hz, ixx, ixy, iyy, ixz, iyz, izz]))
