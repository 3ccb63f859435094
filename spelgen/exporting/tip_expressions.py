"""Where the tip is and how it moves, as CasADi expressions, by the URDF's own numbers."""

from __future__ import annotations

import casadi as ca
import numpy as np

from spelgen.exporting.description import TipJoint, TrainedModel


def tip(model: TrainedModel, q: ca.SX) -> tuple[ca.SX, ca.SX]:
    """The tip link's pose in the root link's frame, (4, 4), and its Jacobian, (6, n): linear, then angular."""
    at = ca.SX.eye(4)
    axes: list[tuple[TipJoint, ca.SX, ca.SX]] = []
    for joint in model.tip:
        at = at @ _exact(joint.origin)
        axes.append((joint, at[:3, :3] @ _exact(joint.axis), at[:3, 3]))
        value = ca.dot(_exact(joint.row), q) + joint.offset
        at = at @ _moved(joint, value)
    at = at @ _exact(model.tip_end)
    jacobian = ca.SX(6, model.n)
    for joint, axis, place in axes:
        turning = joint.kind == "revolute"
        linear = ca.cross(axis, at[:3, 3] - place) if turning else axis
        column = ca.vertcat(linear, axis if turning else ca.SX(3, 1))
        jacobian = jacobian + column @ _exact(joint.row).T
    return at, jacobian


def _moved(joint: TipJoint, value: ca.SX) -> ca.SX:
    found = ca.SX.eye(4)
    if joint.kind == "prismatic":
        found[:3, 3] = _exact(joint.axis) * value
        return found
    x, y, z = joint.axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    outer = np.outer(joint.axis, joint.axis)
    # cos (1 - a a^T) + sin [a]x + a a^T
    found[:3, :3] = ca.cos(value) * _exact(np.eye(3) - outer) + ca.sin(value) * _exact(cross) + _exact(outer)
    return found


def _exact(values: np.ndarray) -> ca.SX:
    return ca.SX(ca.sparsify(ca.DM(values)))
