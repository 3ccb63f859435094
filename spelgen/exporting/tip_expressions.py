"""The tip's pose and Jacobian as CasADi expressions, by the URDF's own numbers."""

from __future__ import annotations

import casadi as ca

from spelgen.exporting.description import TrainedModel
from spelgen.exporting.rigid_expressions import constant, rotation_about_z


def tip_expressions(model: TrainedModel, q: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return the tip link's pose in the root link's frame, (4, 4), and its Jacobian, (6, n): linear, then angular."""
    pose = ca.SX.eye(4)
    frames: list[ca.SX] = []
    for joint in model.tip:
        pose = pose @ constant(joint.origin)
        frames.append(pose)
        value = ca.dot(constant(joint.row), q) + joint.offset
        motion = ca.SX.eye(4)
        if joint.revolute:
            motion[:3, :3] = rotation_about_z(value)
        else:
            motion[2, 3] = value
        pose = pose @ motion
    pose = pose @ constant(model.tip_end)
    jacobian = ca.SX(6, model.n)
    for joint, frame in zip(model.tip, frames, strict=True):
        # the axis is z of the joint's frame
        axis = frame[:3, 2]
        column = ca.vertcat(axis, ca.SX(3, 1))
        if joint.revolute:
            column = ca.vertcat(ca.cross(axis, pose[:3, 3] - frame[:3, 3]), axis)
        jacobian = jacobian + column @ constant(joint.row).T
    return pose, jacobian
