"""Rigid bodies as CasADi expressions: Newton-Euler forward and back, and composite bodies for M.

Each body is seen in its joint's frame, whose z the joint turns about or slides along (Featherstone, Rigid Body Dynamics
Algorithms, 2008, sections 5.3 and 6.2, in the classical form of Khalil and Dombre, 2002, section 9.5). Zeros of the
geometry are left out by CasADi as the expressions are made.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from spelgen.exporting.description import TrainedModel


@dataclass(frozen=True, eq=False)
class _Link:
    """A body in expressions: its frame in its parent's, and what it is made of; all 3 rows."""

    parent: int
    joint: int
    ratio: float
    revolute: bool
    rotation: ca.SX
    position: ca.SX
    mass: ca.SX
    moment: ca.SX
    inertia: ca.SX


class RigidExpressions:
    """An arm's rigid bodies at q, a column of n symbols; armature is not among them."""

    def __init__(self, model: TrainedModel, q: ca.SX) -> None:
        self.n = model.n
        self.weight = ca.SX(-model.gravity)
        self.links = [_link(model, index, q) for index in range(len(model.bodies))]

    def torque(self, qd: ca.SX | None, qdd: ca.SX | None) -> ca.SX:
        """What the joints must give for this motion, (n, 1); None: zero."""
        still = qd is None and qdd is None
        zero = ca.SX(3, 1)
        turns: list[ca.SX] = []
        rates: list[ca.SX] = []
        moves: list[tuple[ca.SX, ca.SX]] = []
        wrenches: list[tuple[ca.SX, ca.SX]] = []
        for link in self.links:
            below = link.parent >= 0
            w = turns[link.parent] if below else zero
            spin, rise = moves[link.parent] if below else (ca.SX(3, 3), self.weight)
            # the acceleration of the origin; spin is [w']x + [w]x [w]x
            rise = link.rotation.T @ (rise + spin @ link.position)
            w = link.rotation.T @ w
            rate = link.rotation.T @ rates[link.parent] if below else zero
            if not still:
                speed, push = (
                    link.ratio * x[link.joint] if x is not None else ca.SX(1, 1) for x in (qd, qdd)
                )
                axis = ca.SX(ca.sparsify(ca.DM([0, 0, 1])))
                if link.revolute:
                    rate = rate + axis * push + ca.cross(w, axis) * speed
                    w = w + axis * speed
                else:
                    rise = rise + axis * push + 2 * ca.cross(w, axis) * speed
            spin = ca.SX(3, 3) if still else ca.skew(rate) + _square(w)
            force = link.mass * rise + spin @ link.moment
            torque = ca.cross(link.moment, rise)
            if not still:
                torque = torque + link.inertia @ rate + ca.cross(w, link.inertia @ w)
            turns.append(w)
            rates.append(rate)
            moves.append((spin, rise))
            wrenches.append((force, torque))
        return self._joints(wrenches)

    def _joints(self, wrenches: list[tuple[ca.SX, ca.SX]]) -> ca.SX:
        """The joints' torques of the bodies' (forces, torques)."""
        found = ca.SX(self.n, 1)
        for index in reversed(range(len(self.links))):
            link, (force, torque) = self.links[index], wrenches[index]
            found[link.joint] += link.ratio * (torque if link.revolute else force)[2]
            if link.parent >= 0:
                force, torque = link.rotation @ force, link.rotation @ torque
                below = wrenches[link.parent]
                wrenches[link.parent] = (
                    below[0] + force,
                    below[1] + torque + ca.cross(link.position, force),
                )
        return found

    def mass_and_moment(self) -> tuple[ca.SX, ca.SX]:
        """M, (n, n), and the moment of mass of all bodies in the base's frame, (3, 1)."""
        mass = [link.mass for link in self.links]
        moment = [link.moment for link in self.links]
        inertia = [link.inertia for link in self.links]
        matrix, total = ca.SX(self.n, self.n), ca.SX(3, 1)
        axis = ca.SX(ca.sparsify(ca.DM([0, 0, 1])))
        for index in reversed(range(len(self.links))):
            link = self.links[index]
            if link.revolute:
                force, torque = ca.cross(axis, moment[index]), inertia[index] @ axis
            else:
                force, torque = mass[index] * axis, ca.cross(moment[index], axis)
            self._add_column(matrix, index, link.ratio * force, link.ratio * torque)
            turned = link.rotation @ moment[index]
            p, m, below = link.position, mass[index], link.parent
            if below < 0:
                total = total + turned + m * p
                continue
            shift = p @ turned.T
            size = m * ca.dot(p, p) + 2 * ca.trace(shift)
            moved = link.rotation @ inertia[index] @ link.rotation.T
            moved = moved + size * ca.SX.eye(3) - m * (p @ p.T) - shift - shift.T
            inertia[below] = inertia[below] + _symmetric(moved)
            moment[below] = moment[below] + turned + m * p
            mass[below] = mass[below] + m
        return matrix, total

    def _add_column(self, matrix: ca.SX, index: int, force: ca.SX, torque: ca.SX) -> None:
        """What a body's own joint, accelerated by one, asks of it and of those before it."""
        at, column = index, self.links[index].joint
        while at >= 0:
            link = self.links[at]
            value = link.ratio * (torque if link.revolute else force)[2]
            matrix[link.joint, column] += value
            if at != index:
                matrix[column, link.joint] += value
            force = link.rotation @ force
            torque = link.rotation @ torque + ca.cross(link.position, force)
            at = link.parent


def _link(model: TrainedModel, index: int, q: ca.SX) -> _Link:
    body, ten = model.bodies[index], model.inertias[index]
    value = float(body.multiplier) * q[body.coordinate] + body.offset
    rotation, position = _exact(body.rotation), _exact(body.translation)
    if body.kind == "revolute":
        rotation = rotation @ turn(value)
    else:
        position = position + rotation[:, 2] * value
    xx, xy, xz, yy, yz, zz = ten[4:]
    return _Link(
        parent=body.parent,
        joint=body.coordinate,
        ratio=float(body.multiplier),
        revolute=body.kind == "revolute",
        rotation=rotation,
        position=position,
        mass=ca.SX(float(ten[0])),
        moment=_exact(ten[1:4]),
        inertia=_exact([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]),
    )


def turn(angle: ca.SX) -> ca.SX:
    """The rotation about z, (3, 3)."""
    c, s = ca.cos(angle), ca.sin(angle)
    found = ca.SX(3, 3)
    found[0, 0] = found[1, 1] = c
    found[0, 1], found[1, 0], found[2, 2] = -s, s, 1
    return found


def _exact(values: object) -> ca.SX:
    return ca.SX(ca.sparsify(ca.DM(np.array(values, dtype=float))))


def _square(w: ca.SX) -> ca.SX:
    """[w]x [w]x."""
    return w @ w.T - ca.dot(w, w) * ca.SX.eye(3)


def _symmetric(matrix: ca.SX) -> ca.SX:
    """The lower triangle's numbers in both places: half of the work."""
    return ca.tril2symm(ca.tril(matrix))
