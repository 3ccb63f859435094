"""The tip's pose and Jacobian as CasADi expressions, by the URDF's own numbers."""

from __future__ import annotations

import casadi as ca

from spelgen.exporting.description import TrainedModel
from spelgen.exporting.rigid_expressions import body_frames, constant


def tip_expressions(model: TrainedModel, q: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return the tip link's pose in the root link's frame, (4, 4), and its Jacobian, (6, n): linear, then angular."""
    bodies = model.unrounded
    frames = body_frames(bodies, q)
    # from the root to the tip
    way: list[int] = []
    index = model.tip.carrier
    while index >= 0:
        way.insert(0, index)
        index = bodies[index].parent
    pose = ca.SX.eye(4)
    placed: list[ca.SX] = []
    for index in way:
        pose = pose @ ca.vertcat(ca.horzcat(*frames[index]), constant([[0, 0, 0, 1]]))
        placed.append(pose)
    pose = pose @ constant(model.tip.pose)
    jacobian = ca.SX(6, model.n)
    for index, frame in zip(way, placed, strict=True):
        body = bodies[index]
        # the axis is z of the body's frame
        axis = frame[:3, 2]
        column = ca.vertcat(axis, ca.SX(3, 1))
        if body.kind == "revolute":
            column = ca.vertcat(ca.cross(axis, pose[:3, 3] - frame[:3, 3]), axis)
        jacobian[:, body.coordinate] += float(body.multiplier) * column
    return pose, jacobian
