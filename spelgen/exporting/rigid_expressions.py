"""Rigid bodies as CasADi expressions: torques by recursive Newton-Euler, M and V by the recursion of the structure.

Bodies are expressed in the frames of their joints, whose z is the joint axis (Featherstone, Rigid Body Dynamics
Algorithms, 2008, section 5.3, in the classical form of Khalil and Dombre, 2002, section 9.5). CasADi omits structural
zeros: of the geometry, and velocities of ``ca.SX(n, 1)``.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from spelgen.arm.arm import Body
from spelgen.exporting.description import TrainedModel
from spelgen.structure.recursion import Position, base_denominators, energies

_Z = ca.sparsify(ca.DM([0, 0, 1]))


def constant(values: object) -> ca.DM:
    """Return numbers (rows, columns) as a CasADi matrix with structural zeros."""
    return ca.sparsify(ca.DM(np.array(values, dtype=float)))


def body_frames(bodies: Sequence[Body], q: ca.SX) -> list[tuple[ca.SX, ca.SX]]:
    """Return rotation (3, 3) and position (3, 1) of each body's frame in the frame of its parent, at q (n, 1)."""
    frames: list[tuple[ca.SX, ca.SX]] = []
    for body in bodies:
        rotation = ca.SX(constant(body.rotation))
        position = ca.SX(constant(body.translation))
        displacement = float(body.multiplier) * q[body.coordinate] + body.offset
        if body.joint_type == "revolute":
            rotation = rotation @ rotation_about_z(displacement)
        else:
            position = position + rotation[:, 2] * displacement
        frames.append((rotation, position))
    return frames


def rigid_torque(model: TrainedModel, frames: list[tuple[ca.SX, ca.SX]], qd: ca.SX, qdd: ca.SX) -> ca.SX:
    """Return the torques of the rigid bodies, without armature, (n, 1) [Nm, N].

    Args:
        model: description.
        frames: from `body_frames` at q.
        qd, qdd: (n, 1); structural zeros are omitted.
    """
    bodies = model.arm.bodies
    # angular velocity, angular acceleration, acceleration and spin of the base, then of the bodies, in their frames;
    # instead of gravity the base accelerates upwards
    gravity = np.array(model.arm.gravity, dtype=float)
    motions = [(ca.SX(3, 1), ca.SX(3, 1), ca.SX(-gravity), ca.SX(3, 3))]
    forces: list[ca.SX] = []
    torques: list[ca.SX] = []
    for body, ten, (rotation, position) in zip(bodies, model.inertias, frames, strict=True):
        w, rate, acceleration, spin = motions[body.parent + 1]
        ratio = float(body.multiplier)
        speed = ratio * qd[body.coordinate]
        added = ratio * qdd[body.coordinate]
        # Everything is in the frame of the body: constants of the body need no rotation.
        acceleration = rotation.T @ (acceleration + spin @ position)
        w, rate = rotation.T @ w, rotation.T @ rate
        turning = ca.cross(w, _Z) * speed
        if body.joint_type == "revolute":
            w = w + _Z * speed
            rate = rate + _Z * added + turning
        else:
            # Coriolis acceleration: 2 w x v
            acceleration = acceleration + _Z * added + 2 * turning
        # spin p is the acceleration of point p relative to the origin
        spin = ca.skew(rate) + w @ w.T - ca.dot(w, w) * ca.SX.eye(3)
        motions.append((w, rate, acceleration, spin))
        m, x, y, z, xx, xy, xz, yy, yz, zz = ten.tolist()
        moment = ca.SX(constant([x, y, z]))
        inertia = ca.SX(constant([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
        # Newton, then Euler about the frame's origin
        forces.append(m * acceleration + spin @ moment)
        torque = ca.cross(moment, acceleration) + inertia @ rate
        torques.append(torque + ca.cross(w, inertia @ w))
    joint_torques = ca.SX(model.n, 1)
    # children come after their parents
    for index in reversed(range(len(bodies))):
        body, force, torque = bodies[index], forces[index], torques[index]
        along_axis = torque[2] if body.joint_type == "revolute" else force[2]
        # mimic joints share the coordinate of their leader
        joint_torques[body.coordinate] += float(body.multiplier) * along_axis
        if body.parent >= 0:
            rotation, position = frames[index]
            force = rotation @ force
            forces[body.parent] += force
            torques[body.parent] += rotation @ torque + ca.cross(position, force)
    return joint_torques


def rigid_momentum(model: TrainedModel, frames: list[tuple[ca.SX, ca.SX]], qd: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return M qd and d/dq of the kinetic energy of the rigid bodies, without armature, (n, 1) each.

    The momentum of the bodies that a joint carries is projected onto its axis S, and onto dS/dt = twist x S.
    """
    bodies = model.arm.bodies
    # angular velocity, and velocity of the origin, of the base, then of the bodies, in their frames
    twists = [(ca.SX(3, 1), ca.SX(3, 1))]
    momenta: list[tuple[ca.SX, ca.SX]] = []
    for body, ten, (rotation, position) in zip(bodies, model.inertias, frames, strict=True):
        w, v = twists[body.parent + 1]
        w, v = rotation.T @ w, rotation.T @ (v + ca.cross(w, position))
        speed = _Z * (float(body.multiplier) * qd[body.coordinate])
        w, v = (w + speed, v) if body.joint_type == "revolute" else (w, v + speed)
        twists.append((w, v))
        m, x, y, z, xx, xy, xz, yy, yz, zz = ten.tolist()
        moment = ca.SX(constant([x, y, z]))
        inertia = ca.SX(constant([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
        momenta.append((m * v + ca.cross(w, moment), inertia @ w + ca.cross(moment, v)))
    momentum, gradient = ca.SX(model.n, 1), ca.SX(model.n, 1)
    for index in reversed(range(len(bodies))):
        body, (linear, angular) = bodies[index], momenta[index]
        w, v = twists[index + 1]
        ratio = float(body.multiplier)
        if body.joint_type == "revolute":
            along, turned = angular[2], ca.dot(ca.cross(w, _Z), angular) + ca.dot(ca.cross(v, _Z), linear)
        else:
            along, turned = linear[2], ca.dot(ca.cross(w, _Z), linear)
        momentum[body.coordinate] += ratio * along
        gradient[body.coordinate] += ratio * turned
        if body.parent >= 0:
            rotation, position = frames[index]
            linear = rotation @ linear
            angular = rotation @ angular + ca.cross(position, linear)
            momenta[body.parent] = momenta[body.parent][0] + linear, momenta[body.parent][1] + angular
    return momentum, gradient


def mass_and_potential(model: TrainedModel, q: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return M, (n, n), and V, (1, 1) [J], of the rigid bodies at q (n, 1), by the recursion of `structure`."""
    positions = []
    for joint, base in enumerate(base_denominators(model.arm)):
        # Angles of mimic joints are integer multiples of the base angle.
        angle = q[joint] / base
        positions.append(Position(ca.cos(angle), ca.sin(angle), q[joint]))
    result = energies(model.arm, positions, model.inertias.tolist(), float)
    mass = ca.SX(model.n, model.n)
    for (row, column), entry in result.mass.items():
        # the same expression in both triangles: CasADi computes it once
        mass[row, column] = mass[column, row] = entry
    return mass, ca.SX(result.potential)


def tip_kinematics(model: TrainedModel, q: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return pose (4, 4) and Jacobian (6, n), linear then angular, of the tip link in the root frame, at q (n, 1)."""
    bodies = model.tip.bodies
    frames = body_frames(bodies, q)
    # poses of the root link, then of all bodies
    poses = [ca.SX.eye(4)]
    for body, frame in zip(bodies, frames, strict=True):
        poses.append(poses[body.parent + 1] @ ca.vertcat(ca.horzcat(*frame), constant([[0, 0, 0, 1]])))
    pose = poses[model.tip.carrier + 1] @ constant(model.tip.pose)
    jacobian = ca.SX(6, model.n)
    index = model.tip.carrier
    while index >= 0:
        body = bodies[index]
        # the axis is z of the body's frame
        axis, origin = poses[index + 1][:3, 2], poses[index + 1][:3, 3]
        column = ca.vertcat(axis, ca.SX(3, 1))
        if body.joint_type == "revolute":
            column = ca.vertcat(ca.cross(axis, pose[:3, 3] - origin), axis)
        jacobian[:, body.coordinate] += float(body.multiplier) * column
        index = body.parent
    return pose, jacobian


def rotation_about_z(angle: ca.SX) -> ca.SX:
    """Return the rotation about z, (3, 3), by an angle (1, 1)."""
    c, s = ca.cos(angle), ca.sin(angle)
    rotation = ca.SX(3, 3)
    rotation[0, 0] = rotation[1, 1] = c
    rotation[1, 0], rotation[0, 1] = s, -s
    rotation[2, 2] = 1
    return rotation
