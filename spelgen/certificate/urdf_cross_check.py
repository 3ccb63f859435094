"""Read the file once more by Pinocchio's own reader: axes of joints, masses and inertias beside the Arm's.

Errors in reading show here that no check of the derivation could see: it starts from the Arm. Pinocchio rounds no
angles, so an arm with rounded ones is taken from the file once more, without rounding.
"""

from __future__ import annotations

import hashlib
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pinocchio as pin
from lxml import etree

from spelgen.arm.arm import Arm, make_arm
from spelgen.certificate.tuning import TUNING
from spelgen.certificate.verification import Check, Verdict, size_text
from spelgen.dynamics.constraint import mimic_constraint
from spelgen.dynamics.pinocchio_arm import arm_dynamics
from spelgen.dynamics.pinocchio_dynamics import PinocchioDynamics
from spelgen.settings.settings import Settings
from spelgen.urdf.document import urdf_bytes
from spelgen.urdf.robot import Robot

TENSOR = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def urdf_cross_check(robot: Robot, arm: Arm, seed: int) -> tuple[Check, ...]:
    """Compare ``arm`` with Pinocchio's reading of the same bytes at random configurations."""
    try:
        dynamics = _pinocchio_dynamics(robot, arm)
    except Exception as problem:  # another program's failure proves nothing about ours
        text = " ".join(str(problem).split())[:120]
        result = f"Pinocchio cannot read it ({type(problem).__name__}: {text})"
        return (Check("reading of the file", "the moving bodies", result, "undecided"),)
    q = np.random.default_rng(seed).uniform(-1.0, 1.0, (6, len(arm.coordinates)))
    gravity = tuple(map(float, arm.gravity))
    as_written = make_arm(robot, joints=arm.joint_names, angle_tolerance=0.0, gravity=gravity)
    theirs = _reading(dynamics, arm, q)
    written, ours = (_reading(_arm_dynamics(variant), arm, q) for variant in (as_written, arm))
    if all(body.inertia is None for body in arm.bodies):
        del written["masses and inertias"]
    is_rounded = any(remark.code.startswith("snapped-") for remark in arm.diagnostics)
    allowed = TUNING.frame_rounding * len(robot.joints)
    checks = []
    for quantity, values in written.items():
        # light bodies count, too: each number beside its own size, but for what is next to nothing
        scale = np.abs(values).max(axis=0) + (1e-3 * np.abs(values).max() or 1.0)
        apart = float((np.abs(theirs[quantity] - values) / scale).max())
        moved = float((np.abs(ours[quantity] - values) / scale).max())
        verdict: Verdict = "agrees"
        if apart > allowed or (moved > allowed and not is_rounded):
            verdict = "differs"
        result = f"at most {size_text(apart)} of their size apart"
        if is_rounded:
            result += f"; the reported roundings move them by {size_text(moved)}"
        checks.append(Check(f"{quantity} in the file", "as Pinocchio reads them", result, verdict))
    return tuple(checks)


def _pinocchio_dynamics(robot: Robot, arm: Arm) -> PinocchioDynamics:
    # the same bytes, or the comparison would prove nothing
    data = urdf_bytes(robot.path)
    if hashlib.sha256(data).hexdigest() != robot.digest:
        raise ValueError("the file has changed since it was read")
    root = etree.fromstring(data, etree.XMLParser(resolve_entities=False, no_network=True))
    # Pinocchio refuses files for limits and friction, which are not compared here
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


def _arm_dynamics(arm: Arm) -> PinocchioDynamics:
    bodies = []
    for body in arm.bodies:
        # a body without an inertial weighs nothing in Pinocchio's reading, too
        bodies.append(replace(body, inertia=body.inertia or (Fraction(0),) * 10))
    return arm_dynamics(replace(arm, bodies=tuple(bodies)), Settings())


def _reading(dynamics: PinocchioDynamics, arm: Arm, q: np.ndarray) -> dict[str, np.ndarray]:
    """Return what one program makes of a file at some configurations, by the joint of each moving body.

    Twists of unit rates in the root's frame, (samples, 6, bodies), and M of these joints with twice its diagonal,
    and behind it the torque of gravity, (samples, bodies, bodies + 1).
    """
    model, data = dynamics.model, dynamics.data
    columns = [model.joints[model.getJointId(body.name)].idx_v for body in arm.bodies]
    axes, loads = [], []
    for configuration in dynamics.configuration(q):
        # of a single joint Pinocchio gives a vector
        axes.append(pin.computeJointJacobians(model, data, configuration).reshape(6, -1)[:, columns])
        # Pinocchio promises the upper triangle only
        upper = np.triu(pin.crba(model, data, configuration))
        mass = upper + upper.T
        gravity = pin.computeGeneralizedGravity(model, data, configuration)
        loads.append(np.column_stack([mass, gravity])[columns][:, [*columns, -1]])
    return {"axes of the joints": np.array(axes), "masses and inertias": np.array(loads)}
