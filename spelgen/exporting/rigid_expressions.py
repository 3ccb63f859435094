"""Rigid bodies as CasADi expressions: torques by recursive Newton-Euler, M and V by ``structure.recursion``.

Quantities of a body are expressed in its joint's frame, whose z is the joint axis (Featherstone, Rigid Body Dynamics
Algorithms, 2008, section 5.3, in the classical form of Khalil and Dombre, 2002, section 9.5). V is the potential
energy. CasADi omits operations with structural zeros, such as zeros of the geometry. If qd is ``ca.SX(n, 1)``, a vector
of structural zeros, all operations with velocities are omitted.
"""

from collections.abc import Sequence

import casadi as ca
import numpy as np

from spelgen.arm.arm import Body, Chain
from spelgen.exporting.describe import TrainedModel
from spelgen.structure.recursion import Position, base_denominators, energies

_Z = ca.sparsify(ca.DM([0, 0, 1]))

Frame = tuple[ca.SX, ca.SX]
"""Rotation (3, 3) and position (3, 1) of a body's frame in the frame of its parent."""
Wrench = tuple[ca.SX, ca.SX]
"""Force and torque, or linear and angular momentum, (3, 1) each, about the origin of a body's frame."""


def constant(values: object) -> ca.DM:
    """Return a matrix (rows, columns) as a sparse CasADi matrix: expressions contain no operations with its zeros."""
    return ca.sparsify(ca.DM(np.array(values, dtype=float)))


def body_frames(bodies: Sequence[Body], q: ca.SX) -> list[Frame]:
    """Return (rotation (3, 3), position (3, 1) [m]) of each body's frame relative to its parent, at q (n, 1)."""
    frames = []
    for body in bodies:
        rotation = ca.SX(constant(body.rotation))
        position = ca.SX(constant(body.translation))
        displacement = float(body.multiplier) * q[body.coordinate] + body.offset
        if body.joint_type == "revolute":
            rotation = rotation @ _rotation_about_z(displacement)
        else:
            position = position + rotation[:, 2] * displacement
        frames.append((rotation, position))
    return frames


class RigidBodies:
    """The rigid bodies of an arm at a position q, (n, 1): functions that return expressions of torque and momentum.

    inertias: inertial parameters, (bodies, 10), or one CasADi vector (10, 1) per body; structural zeros cause no
    operations.
    """

    def __init__(self, arm: Chain, q: ca.SX, inertias: Sequence[ca.SX] | np.ndarray) -> None:
        # `torque` and `momentum` use the same frames, so that sines and cosines are computed once.
        self.arm, self.bodies, self.frames = arm, arm.bodies, body_frames(arm.bodies, q)
        parameters = []
        for ten in map(ca.sparsify, map(ca.SX, inertias)):
            # The ten parameters are mass, first moment (3), and the tensor's xx, xy, xz, yy, yz, zz.
            tensor = ca.reshape(ten[[4, 5, 6, 5, 7, 8, 6, 8, 9]], 3, 3)
            parameters.append((ten[0], ten[1:4], tensor))
        # Per body, parents first: the body; mass, first moment (3, 1) and inertia tensor (3, 3); frame.
        self._rows = list(zip(self.bodies, parameters, self.frames, strict=True))

    def torque(self, qd: ca.SX, qdd: ca.SX) -> ca.SX:
        """Return M qdd + h without armature, (n, 1) [Nm, N], with h: Coriolis, centrifugal and gravity torque.

        Structural zeros of qd cause no operations.
        """
        # `motions` has the motion of the base, then of each body, in the frame of the body: angular velocity w, angular
        # acceleration w', acceleration of the frame's origin, and the matrix skew(w') + w w^T - |w|^2 1 (`spin`).
        # Gravity is represented by an upward acceleration of the base.
        gravity = np.array(self.arm.gravity, dtype=float)
        motions = [(ca.SX(3, 1), ca.SX(3, 1), ca.SX(-gravity), ca.SX(3, 3))]
        wrenches = []
        for body, (mass, moment, inertia), (rotation, position) in self._rows:
            w, rate, acceleration, spin = motions[body.parent + 1]
            ratio = float(body.multiplier)
            speed, added = ratio * qd[body.coordinate], ratio * qdd[body.coordinate]
            # The motion of the parent is transformed into the frame of the body, in which first moment and inertia
            # tensor are constant.
            acceleration = rotation.T @ (acceleration + spin @ position)
            w, rate = rotation.T @ w, rotation.T @ rate
            turning = ca.cross(w, _Z) * speed
            if body.joint_type == "revolute":
                w = w + _Z * speed
                rate = rate + _Z * added + turning
            else:
                # 2 w x v is the Coriolis acceleration, with the velocity v along the prismatic joint.
                acceleration = acceleration + _Z * added + 2 * turning
            # With the matrix `spin`, spin @ p is the acceleration of a point p of the body relative to the origin.
            spin = ca.skew(rate) + w @ w.T - ca.dot(w, w) * ca.SX.eye(3)
            motions.append((w, rate, acceleration, spin))
            # Newton's equation gives the force; Euler's equation about the origin of the frame gives the torque.
            force = mass * acceleration + spin @ moment
            torque = ca.cross(moment, acceleration) + inertia @ rate
            wrenches.append((force, torque + ca.cross(w, inertia @ w)))
        self._accumulate(wrenches)
        torques = ca.SX(len(self.arm.coordinates), 1)
        for body, wrench in reversed(list(zip(self.bodies, wrenches, strict=True))):
            # A mimic joint has the coordinate of its leader, so its torque is added there, times its multiplier.
            torques[body.coordinate] += float(body.multiplier) * _axis_component(body, wrench)
        return torques

    def momentum(self, qd: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Return the momentum M qd, (n, 1), and d/dq of the kinetic energy, (n, 1), both without armature.

        Let h be the spatial momentum of all bodies that a joint carries, S the unit twist of the joint, and v the twist
        (spatial velocity) of its child body. The entry of M qd is S . h. The entry of the gradient is (dS/dt) . h, with
        dS/dt = v x S.
        """
        # `twists` has the twist of the base, then of each body, in its own frame: angular velocity, and velocity of the
        # origin.
        twists = [(ca.SX(3, 1), ca.SX(3, 1))]
        momenta = []
        for body, (mass, moment, inertia), (rotation, position) in self._rows:
            w, v = twists[body.parent + 1]
            w, v = rotation.T @ w, rotation.T @ (v + ca.cross(w, position))
            speed = _Z * (float(body.multiplier) * qd[body.coordinate])
            w, v = (w + speed, v) if body.joint_type == "revolute" else (w, v + speed)
            twists.append((w, v))
            momenta.append((mass * v + ca.cross(w, moment), inertia @ w + ca.cross(moment, v)))
        self._accumulate(momenta)
        momentum, gradient = ca.SX(qd.shape[0], 1), ca.SX(qd.shape[0], 1)
        for body, (w, v), (linear, angular) in zip(self.bodies, twists[1:], momenta, strict=True):
            turned = ca.dot(ca.cross(w, _Z), linear)
            if body.joint_type == "revolute":
                turned = ca.dot(ca.cross(w, _Z), angular) + ca.dot(ca.cross(v, _Z), linear)
            ratio = float(body.multiplier)
            momentum[body.coordinate] += ratio * _axis_component(body, (linear, angular))
            gradient[body.coordinate] += ratio * turned
        return momentum, gradient

    def _accumulate(self, wrenches: list[Wrench]) -> None:
        """Add the wrench of each body to the wrench of its parent, from the tip to the base, in place.

        Each result is the sum over a body and all bodies that it carries. wrenches: one per body, in the frame of the
        body, parents first.
        """
        for index in reversed(range(len(wrenches))):
            parent = self.bodies[index].parent
            if parent >= 0:
                rotation, position = self.frames[index]
                force, torque = wrenches[parent]
                added = rotation @ wrenches[index][0]
                turned = rotation @ wrenches[index][1] + ca.cross(position, added)
                wrenches[parent] = force + added, torque + turned


def _axis_component(body: Body, wrench: Wrench) -> ca.SX:
    """Return the force along a prismatic joint's axis, or the torque about a revolute joint's axis, (1, 1)."""
    return wrench[1][2] if body.joint_type == "revolute" else wrench[0][2]


def mass_and_potential(model: TrainedModel, q: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return M, (n, n), and potential energy, (1, 1) [J], of rigid bodies at q, (n, 1), by ``structure.recursion``."""
    positions = []
    for joint, base in enumerate(base_denominators(model.arm)):
        # All angles of mimic joints are integer multiples of q / `base`: their cosines and sines are polynomials in
        # cos(q / `base`) and sin(q / `base`).
        angle = q[joint] / base
        positions.append(Position(ca.cos(angle), ca.sin(angle), q[joint]))
    result = energies(model.arm, positions, model.inertias.tolist(), float)
    mass = ca.SX(model.n, model.n)
    for (row, column), entry in result.mass.items():
        # Both triangles of M have the same expression, which CasADi computes once.
        mass[row, column] = mass[column, row] = entry
    return mass, ca.SX(result.potential)


def frame_kinematics(bodies: Sequence[Body], carrier: int, pose: np.ndarray, q: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return pose (4, 4) and Jacobian (6, n) of a frame of a body relative to the root frame, at q (n, 1).

    The rows of the Jacobian are linear, then angular velocity.

    carrier: index of the body that carries the frame; -1: the root link. pose: pose in the frame of this body, (4, 4).
    """
    # `poses` has the poses of the root link and of all bodies; CasADi removes poses on which the result does not
    # depend.
    poses = [ca.SX.eye(4)]
    for body, frame in zip(bodies, body_frames(bodies, q), strict=True):
        poses.append(poses[body.parent + 1] @ ca.vertcat(ca.horzcat(*frame), constant([[0, 0, 0, 1]])))
    placed = poses[carrier + 1] @ constant(pose)
    jacobian = ca.SX(6, q.shape[0])
    while carrier >= 0:
        body = bodies[carrier]
        # the joint axis is the z axis of the body's frame
        axis, origin = poses[carrier + 1][:3, 2], poses[carrier + 1][:3, 3]
        column = ca.vertcat(axis, ca.SX(3, 1))
        if body.joint_type == "revolute":
            column = ca.vertcat(ca.cross(axis, placed[:3, 3] - origin), axis)
        jacobian[:, body.coordinate] += float(body.multiplier) * column
        carrier = body.parent
    return placed, jacobian


def _rotation_about_z(angle: ca.SX) -> ca.SX:
    """Return the matrix of the rotation about z, (3, 3), by an angle, (1, 1) [rad]."""
    c, s = ca.cos(angle), ca.sin(angle)
    return ca.diagcat(ca.blockcat([[c, -s], [s, c]]), 1)
