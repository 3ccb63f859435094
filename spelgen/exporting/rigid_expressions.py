"""Rigid bodies as CasADi expressions: torques by recursive Newton-Euler, M and V by the structure's own recursion.

Each body is seen in its joint's frame, whose z the joint turns about or slides along (Featherstone, Rigid Body Dynamics
Algorithms, 2008, section 5.3, in the classical form of Khalil and Dombre, 2002, section 9.5). CasADi leaves
out what is structurally zero: zeros of the geometry, and velocities that are given as ``ca.SX(n, 1)``.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from spelgen.exporting.description import TrainedModel
from spelgen.structure.recursion import energies
from spelgen.structure.sampling import Position, base_denominators, motions

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
        self._base = _Motion(ca.SX(3, 1), ca.SX(3, 1), ca.SX(-np.array(model.arm.gravity, dtype=float)))
        self._links = [_link(model, index, q) for index in range(len(model.arm.bodies))]

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
            link, force, torque = self._links[index], forces[index], torques[index]
            along_axis = torque[2] if link.revolute else force[2]
            # several bodies share a joint where one follows another
            joint_torques[link.joint] += link.ratio * along_axis
            if link.parent >= 0:
                force = link.rotation @ force
                forces[link.parent] += force
                torques[link.parent] += link.rotation @ torque + ca.cross(link.position, force)
        return joint_torques


def mass_and_potential(model: TrainedModel, q: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return M, (n, n), and V [J] of the rigid bodies: the recursion of the structure, over CasADi's scalars."""
    positions = []
    for joint, base in enumerate(base_denominators(model.arm)):
        angle = q[joint] / base
        positions.append(Position(ca.cos(angle), ca.sin(angle), q[joint]))
    result = energies(model.arm, motions(model.arm, positions, float), model.inertias.tolist(), float)
    mass = ca.SX(model.n, model.n)
    for (row, column), entry in result.mass.items():
        # one expression for both triangles: half of the work
        mass[row, column] = mass[column, row] = entry
    return mass, ca.SX(result.potential)


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
    body = model.arm.bodies[index]
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
