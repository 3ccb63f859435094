"""Exact poses of joints and links at zero position, and inertias in the frame of the body they move with.

A rotation composed of decimal angles is no rational matrix, so it is composed in float64 over the longest
stretch that no revolute joint interrupts, and made rational once: 45 degrees, a prismatic joint and another
45 degrees are exactly 90, and every rotation is exactly orthogonal.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from math import inf

import numpy as np

from spelgen.arm.angle_rounding import AngleRounding
from spelgen.arm.rational import (
    IDENTITY,
    ZERO,
    Matrix,
    Vector,
    alignment,
    exact,
    exact_rotation,
    lost_zeros,
    product,
    rotated,
    rotated_tensor,
    rotation_about,
    summed,
    transposed,
)
from spelgen.urdf.robot import Inertial, Joint, Link

TenVector = tuple[Fraction, ...]


@dataclass(frozen=True)
class Frame:
    """A link's frame at zero position, in the frame of the body it moves with (-1: the root link).

    ``composed`` (3, 3) is its float64 rotation in the frame of the last revolute body on the way,
    ``rotation`` the exact one in the body's own frame; they differ where prismatic bodies lie between.
    """

    body: int
    composed: np.ndarray
    rotation: Matrix
    position: Vector


@dataclass(frozen=True)
class _Turned:
    """A frame's rotation in the frame of the last revolute body before it, (3, 3) float64 and rational."""

    composed: np.ndarray
    exact: Matrix


_STRAIGHT = _Turned(np.eye(3), IDENTITY)


@dataclass(frozen=True)
class Pose:
    """A joint's own frame, with +z along its axis, in the frame of the body ``parent``."""

    parent: int
    rotation: Matrix
    translation: Vector


class Placement:
    """From the root outwards: every joint is either held, or starts a body of its own."""

    def __init__(self, root: str, rounding: AngleRounding) -> None:
        self.frames = {root: Frame(-1, np.eye(3), IDENTITY, ZERO)}
        self._rounding = rounding
        # by body, the frames from the last revolute body above it, or itself, to its own
        self._stretches: list[tuple[_Turned, ...]] = [(_STRAIGHT,)]

    def hold(self, joint: Joint, value: float) -> None:
        """Place the child of a joint that stays at ``value`` [rad or m]."""
        at = self._joint_origin(joint)
        if value and joint.type == "prismatic":
            axis = self._rounding.axis(joint)
            x, y, z = (exact(float(component)) * exact(value) for component in axis)
            shifted = self._rounding.position(summed(at.position, rotated(at.rotation, (x, y, z))))
            at = Frame(at.body, at.composed, at.rotation, shifted)
        elif value:
            turn = rotation_about(self._rounding.axis(joint), self._rounding.angle(value))
            composed = at.composed @ turn
            at = Frame(at.body, composed, self._in_body(at.body, composed), at.position)
        self.frames[joint.child] = at

    def move(self, joint: Joint) -> Pose:
        """Place a moving joint and its child, which start a body; bodies are numbered by order of calls."""
        at = self._joint_origin(joint)
        turned = alignment(self._rounding.axis(joint))
        along = at.composed @ turned
        rotation = self._in_body(at.body, along)
        slides = joint.type == "prismatic"
        stretch = self._stretches[at.body + 1]
        own = _Turned(along, product(stretch[-1].exact, rotation))
        body = len(self._stretches) - 1
        composed = at.composed if slides else turned.T
        self._stretches.append((*stretch, own) if slides else (_STRAIGHT,))
        self.frames[joint.child] = Frame(body, composed, self._in_body(body, composed), ZERO)
        return Pose(at.body, rotation, self._seen_from_both(rotation, at.position))

    def inertia(self, link: Link, inertial: Inertial) -> TenVector:
        """The link's (m, m c, I) about its body's origin, in the body's frame (parallel-axis theorem)."""
        frame = self.frames[link.name]
        offset, turn = self._rounding.inertial_origin(link, inertial)
        rotation = frame.rotation if turn is None else self._in_body(frame.body, frame.composed @ turn)
        x, y, z = self._rounding.position(summed(frame.position, rotated(frame.rotation, offset)))
        mass = exact(inertial.mass)
        xx, xy, xz, yy, yz, zz = rotated_tensor(rotation, self._rounding.tensor(link, inertial))
        return (
            mass,
            mass * x,
            mass * y,
            mass * z,
            xx + mass * (y * y + z * z),
            xy - mass * x * y,
            xz - mass * x * z,
            yy + mass * (x * x + z * z),
            yz - mass * y * z,
            zz + mass * (x * x + y * y),
        )

    def _joint_origin(self, joint: Joint) -> Frame:
        frame = self.frames[joint.parent]
        offset, turn = self._rounding.joint_origin(joint)
        position = self._rounding.position(summed(frame.position, rotated(frame.rotation, offset)))
        if turn is None:
            return Frame(frame.body, frame.composed, frame.rotation, position)
        composed = frame.composed @ turn
        return Frame(frame.body, composed, self._in_body(frame.body, composed), position)

    def _seen_from_both(self, rotation: Matrix, position: Vector) -> Vector:
        """The position of a joint, without noise in its parent's frame nor, where both can be, in its own.

        An offset of (0.1, 0.1, 0) goes exactly along an axis of 45 degrees, but not along a rational one.
        """
        own = self._rounding.position(rotated(transposed(rotation), position))
        moved = self._rounding.position(rotated(rotation, own))
        return moved if rotated(transposed(rotation), moved) == own else position

    def _in_body(self, body: int, composed: np.ndarray) -> Matrix:
        """The exact rotation in the body's frame of what is turned by ``composed`` in its stretch's.

        It is made rational in the frame, of those on the way, in which it then keeps most zeros seen from
        all of them: an axis of 45 degrees, no rational one, may be square to several.
        """
        stretch = self._stretches[body + 1]
        seen = [frame.composed.T @ composed for frame in stretch]
        best, fewest = IDENTITY, inf
        for frame, turned in zip(stretch, seen, strict=True):
            candidate = product(frame.exact, exact_rotation(turned))
            lost = sum(
                lost_zeros(product(transposed(other.exact), candidate), view)
                for other, view in zip(stretch, seen, strict=True)
            )
            if lost < fewest:
                best, fewest = candidate, lost
            if not lost:
                break
        return product(transposed(stretch[-1].exact), best)
