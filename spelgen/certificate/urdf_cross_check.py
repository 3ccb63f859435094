"""Comparison of a chain with Pinocchio's reading of the URDF: axes of joints, masses and inertias.

It detects errors of reading. Checks of the derivation cannot detect them: the derivation starts from the chain.
Pinocchio does not round angles: a chain with rounded angles is also made from the file without rounding.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
import pinocchio as pin
from lxml import etree

from spelgen.arm.arm import Chain, make_arm
from spelgen.dynamics.constraint import mimic_constraint
from spelgen.dynamics.pinocchio_arm import arm_dynamics
from spelgen.dynamics.pinocchio_dynamics import PinocchioDynamics
from spelgen.settings.settings import Settings
from spelgen.urdf.document import urdf_bytes
from spelgen.urdf.robot import Robot

TENSOR = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


@dataclass(frozen=True)
class ReadingDifference:
    """Largest differences of a quantity, relative to its size: from Pinocchio's reading, and by rounded angles."""

    quantity: str
    difference: float
    rounding: float


def differences_of_reading(robot: Robot, arm: Chain, seed: int) -> list[ReadingDifference]:
    """Compare ``arm`` with Pinocchio's reading of the same bytes at random configurations.

    Raises any exception of Pinocchio, and ValueError if the file has changed.
    """
    dynamics = _pinocchio_dynamics(robot, arm)
    q = np.random.default_rng(seed).uniform(-1.0, 1.0, (6, len(arm.coordinates)))
    gravity = tuple(map(float, arm.gravity))
    as_written = make_arm(robot, joints=arm.joint_names, angle_tolerance=0.0, gravity=gravity)
    theirs = _reading(dynamics, arm, q)
    written, ours = (_reading(_arm_dynamics(variant), arm, q) for variant in (as_written, arm))
    if all(body.inertia is None for body in arm.bodies):
        del written["masses and inertias"]
    differences = []
    for quantity, values in written.items():
        # Relative to the magnitude of each number, so that light bodies count; bounded below against rounding errors.
        scale = np.abs(values).max(axis=0) + (1e-3 * np.abs(values).max() or 1.0)
        pair = (np.abs(other[quantity] - values) / scale for other in (theirs, ours))
        differences.append(ReadingDifference(quantity, *(float(apart.max()) for apart in pair)))
    return differences


def _pinocchio_dynamics(robot: Robot, arm: Chain) -> PinocchioDynamics:
    """Return the dynamics of the URDF by Pinocchio's reader. Raises ValueError if the file has changed."""
    data = urdf_bytes(robot.path)
    if hashlib.sha256(data).hexdigest() != robot.digest:
        raise ValueError("the file has changed since it was read")
    root = etree.fromstring(data, etree.XMLParser(resolve_entities=False, no_network=True))
    # Pinocchio rejects files with some limits and friction, which are not compared.
    for element in [*root.iter("limit"), *root.iter("dynamics")]:
        element.getparent().remove(element)
    for joint in root.iterfind("joint"):
        etree.SubElement(joint, "limit", lower="-1", upper="1", effort="1", velocity="1")
    for inertial in root.iterfind("link/inertial[mass]"):
        if inertial.find("inertia") is None:
            etree.SubElement(inertial, "inertia", dict.fromkeys(TENSOR, "0"))
    model = pin.buildModelFromXML(etree.tostring(root, encoding="unicode"))
    model.gravity.linear = np.array(arm.gravity, dtype=float)
    return PinocchioDynamics(model, mimic_constraint(robot, arm.joint_names))


def _arm_dynamics(arm: Chain) -> PinocchioDynamics:
    bodies = []
    for body in arm.bodies:
        # In Pinocchio's reading, a body without inertial has no mass.
        bodies.append(replace(body, inertia=body.inertia or (Fraction(0),) * 10))
    return arm_dynamics(replace(arm, bodies=tuple(bodies)), Settings())


def _reading(dynamics: PinocchioDynamics, arm: Chain, q: np.ndarray) -> dict[str, np.ndarray]:
    """Return kinematic and dynamic quantities of the B moving bodies at positions q (S, n).

    "axes of the joints": twists of unit rates in the root frame, (S, 6, B). "masses and inertias": M with twice its
    diagonal, and the gravity torque as the last column, (S, B, B + 1).
    """
    model, data = dynamics.model, dynamics.data
    columns = [model.joints[model.getJointId(body.name)].idx_v for body in arm.bodies]
    axes, loads = [], []
    for configuration in dynamics.configuration(q):
        # Pinocchio returns a vector for a single joint.
        axes.append(pin.computeJointJacobians(model, data, configuration).reshape(6, -1)[:, columns])
        # Pinocchio computes the upper triangle only.
        upper = np.triu(pin.crba(model, data, configuration))
        mass = upper + upper.T
        gravity = pin.computeGeneralizedGravity(model, data, configuration)
        loads.append(np.column_stack([mass, gravity])[columns][:, [*columns, -1]])
    return {"axes of the joints": np.array(axes), "masses and inertias": np.array(loads)}
