"""Rigid bodies as CasADi expressions: recursive Newton-Euler, and composite bodies for the mass matrix.

Each body is seen in its joint's frame, whose z the joint turns about or slides along (Featherstone, Rigid Body Dynamics
Algorithms, 2008, sections 5.3 and 6.2, in the classical form of Khalil and Dombre, 2002, section 9.5). CasADi leaves
out what is structurally zero: zeros of the geometry, and velocities that are given as ``ca.SX(n, 1)``.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from spelgen.exporting.description import TrainedModel

_Z = ca.sparsify(ca.DM([0, 0, 1]))


def constant(values: object) -> ca.DM:
    """Return numbers as a CasADi matrix whose zeros are structural."""
    return ca.sparsify(ca.DM(np.array(values, dtype=float)))


@dataclass(frozen=True, eq=False)
class _Link:
    """A body: its frame in its parent's, and its mass, first moment and inertia about its frame's origin."""

    parent: int
    joint: int
    ratio: float
    revolute: bool
    rotation: ca.SX
    position: ca.SX
    mass: ca.SX
    moment: ca.SX
    inertia: ca.SX

    def along_axis(self, force: ca.SX, torque: ca.SX) -> ca.SX:
        """Return what a wrench on the body asks of its joint's coordinate [Nm, N]."""
        if self.revolute:
            return self.ratio * torque[2]
        return self.ratio * force[2]

    def in_parent(self, force: ca.SX, torque: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Return a wrench in the parent's frame, about its origin."""
        force = self.rotation @ force
        return force, self.rotation @ torque + ca.cross(self.position, force)


@dataclass(frozen=True, eq=False)
class _Motion:
    """Angular velocity and acceleration, and the acceleration of the origin, in the body's frame."""

    velocity: ca.SX
    rate: ca.SX
    acceleration: ca.SX

    def spin(self) -> ca.SX:
        """Return [w']x + [w]x [w]x, which takes points of the body to their accelerations."""
        w = self.velocity
        return ca.skew(self.rate) + w @ w.T - ca.dot(w, w) * ca.SX.eye(3)


class RigidExpressions:
    """The rigid bodies of an arm at q, (n, 1); armature is not among them."""

    def __init__(self, model: TrainedModel, q: ca.SX) -> None:
        self.n = model.n
        # in place of gravity the base accelerates upwards
        self._base = _Motion(ca.SX(3, 1), ca.SX(3, 1), ca.SX(-model.gravity))
        self._links = [_link(model, index, q) for index in range(len(model.bodies))]

    def torque(self, qd: ca.SX, qdd: ca.SX) -> ca.SX:
        """Return the torques of this motion in gravity, (n, 1) [Nm, N]."""
        motions: list[_Motion] = []
        forces: list[ca.SX] = []
        torques: list[ca.SX] = []
        for link in self._links:
            carrier = motions[link.parent] if link.parent >= 0 else self._base
            speed = link.ratio * qd[link.joint]
            acceleration = link.ratio * qdd[link.joint]
            motion = _moved(link, carrier, speed, acceleration)
            motions.append(motion)
            # Newton, then Euler about the frame's origin
            forces.append(link.mass * motion.acceleration + motion.spin() @ link.moment)
            torque = ca.cross(link.moment, motion.acceleration)
            torque = torque + link.inertia @ motion.rate
            w = motion.velocity
            torques.append(torque + ca.cross(w, link.inertia @ w))
        joint_torques = ca.SX(self.n, 1)
        # children stand behind their parents
        for index in reversed(range(len(self._links))):
            link = self._links[index]
            # several bodies share a joint where one follows another
            joint_torques[link.joint] += link.along_axis(forces[index], torques[index])
            if link.parent >= 0:
                force, torque = link.in_parent(forces[index], torques[index])
                forces[link.parent] = forces[link.parent] + force
                torques[link.parent] = torques[link.parent] + torque
        return joint_torques

    def mass_and_moment(self) -> tuple[ca.SX, ca.SX]:
        """Return M, (n, n), and the first moment of all bodies in the base's frame, (3, 1) [kg m]."""
        mass = [link.mass for link in self._links]
        moment = [link.moment for link in self._links]
        inertia = [link.inertia for link in self._links]
        matrix = ca.SX(self.n, self.n)
        total = ca.SX(3, 1)
        for index in reversed(range(len(self._links))):
            link = self._links[index]
            # the wrench on all that the joint carries, by a unit acceleration of it
            if link.revolute:
                force = ca.cross(_Z, moment[index])
                torque = inertia[index] @ _Z
            else:
                force = mass[index] * _Z
                torque = ca.cross(moment[index], _Z)
            self._add_column(matrix, index, link.ratio * force, link.ratio * torque)
            m = mass[index]
            p = link.position
            turned = link.rotation @ moment[index]
            parent = link.parent
            if parent < 0:
                total = total + turned + m * p
                continue
            # the parallel axis theorem for a frame that is not at the centre of mass
            shift = p @ turned.T
            size = m * ca.dot(p, p) + 2 * ca.trace(shift)
            moved = link.rotation @ inertia[index] @ link.rotation.T
            moved = moved + size * ca.SX.eye(3) - m * (p @ p.T) - shift - shift.T
            # one expression for both triangles: half of the work
            inertia[parent] = inertia[parent] + ca.tril2symm(ca.tril(moved))
            moment[parent] = moment[parent] + turned + m * p
            mass[parent] = mass[parent] + m
        return matrix, total

    def _add_column(self, matrix: ca.SX, index: int, force: ca.SX, torque: ca.SX) -> None:
        """Add the wrench of a body's own joint, accelerated by one, to that joint's column of M and to its row."""
        # M is symmetric: a row is the column
        column = self._links[index].joint
        # bodies that do not carry this one feel nothing of it
        ancestor = index
        while ancestor >= 0:
            link = self._links[ancestor]
            value = link.along_axis(force, torque)
            matrix[link.joint, column] += value
            if ancestor != index:
                matrix[column, link.joint] += value
            force, torque = link.in_parent(force, torque)
            ancestor = link.parent


def _moved(link: _Link, carrier: _Motion, speed: ca.SX, acceleration: ca.SX) -> _Motion:
    """Return a body's motion by its carrier's and by its own joint's."""
    w = link.rotation.T @ carrier.velocity
    rate = link.rotation.T @ carrier.rate
    linear = link.rotation.T @ (carrier.acceleration + carrier.spin() @ link.position)
    turning = ca.cross(w, _Z) * speed
    if link.revolute:
        return _Motion(w + _Z * speed, rate + _Z * acceleration + turning, linear)
    # Coriolis: twice, for the point moves and its direction turns
    return _Motion(w, rate, linear + _Z * acceleration + 2 * turning)


def _link(model: TrainedModel, index: int, q: ca.SX) -> _Link:
    body = model.bodies[index]
    m, x, y, z, xx, xy, xz, yy, yz, zz = model.inertias[index]
    ratio = float(body.multiplier)
    revolute = body.kind == "revolute"
    rotation = ca.SX(constant(body.rotation))
    position = ca.SX(constant(body.translation))
    displacement = ratio * q[body.coordinate] + body.offset
    if revolute:
        rotation = rotation @ rotation_about_z(displacement)
    else:
        position = position + rotation[:, 2] * displacement
    return _Link(
        parent=body.parent,
        joint=body.coordinate,
        ratio=ratio,
        revolute=revolute,
        rotation=rotation,
        position=position,
        mass=ca.SX(float(m)),
        moment=ca.SX(constant([x, y, z])),
        inertia=ca.SX(constant([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])),
    )


def rotation_about_z(angle: ca.SX) -> ca.SX:
    """Return the rotation about z, (3, 3)."""
    c, s = ca.cos(angle), ca.sin(angle)
    rotation = ca.SX(3, 3)
    rotation[0, 0] = rotation[1, 1] = c
    rotation[1, 0], rotation[0, 1] = s, -s
    rotation[2, 2] = 1
    return rotation
