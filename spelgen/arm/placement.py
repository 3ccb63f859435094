"""Exact poses of joints and links at zero position, and inertias in the frame of the body they move with.

A rotation composed of decimal angles is no rational matrix, so it is composed in float64 over the longest
stretch that no revolute joint interrupts, and made rational once: 45 degrees, a prismatic joint and another
45 degrees are exactly 90, and every rotation is exactly orthogonal.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from spelgen.arm.angle_rounding import AngleRounding
from spelgen.arm.rational import IDENTITY, ZERO, alignment, exact, exact_rotation, lost_zeros, rotation_about
from spelgen.urdf.robot import Inertial, Joint, Link

TenVector = tuple[Fraction, ...]


@dataclass(frozen=True, eq=False)
class Frame:
    """Hold a link's frame at zero position, in the frame of the body it moves with (-1: the root link).

    ``composed`` (3, 3) is its float64 rotation in the frame of the last revolute body on the way,
    ``rotation`` the exact one in the body's own frame; they differ where prismatic bodies lie between.
    """

    body: int
    composed: np.ndarray
    rotation: np.ndarray
    position: np.ndarray


@dataclass(frozen=True, eq=False)
class _StretchFrame:
    """Hold a frame's rotation in the frame of the last revolute body before it, (3, 3) float64 and rational."""

    composed: np.ndarray
    exact: np.ndarray


_STRAIGHT = _StretchFrame(np.eye(3), IDENTITY)


@dataclass(frozen=True, eq=False)
class Pose:
    """Hold a joint's own frame, with +z along its axis, in the frame of the body ``parent``."""

    parent: int
    rotation: np.ndarray
    translation: np.ndarray


class Placement:
    """Place links from the root outwards: every joint is either held, or starts a body of its own."""

    def __init__(self, root: str, rounding: AngleRounding) -> None:
        self.frames = {root: Frame(-1, np.eye(3), IDENTITY, ZERO)}
        self._rounding = rounding
        # by body, the frames from the last revolute body above it, or itself, to its own
        self._stretches: list[tuple[_StretchFrame, ...]] = [(_STRAIGHT,)]

    def hold(self, joint: Joint, value: float) -> None:
        """Place the child of a joint that stays at ``value`` [rad or m]."""
        frame = self._joint_origin(joint)
        if value and joint.type == "prismatic":
            frame = self._slid(frame, self._rounding.axis(joint), value)
        elif value:
            turn = rotation_about(self._rounding.axis(joint), self._rounding.angle(value))
            frame = self._turned(frame, frame.position, turn)
        self.frames[joint.child] = frame

    def move(self, joint: Joint) -> Pose:
        """Place a moving joint and its child, which start a body; bodies are numbered by order of calls."""
        frame = self._joint_origin(joint)
        # the recursion knows joints about z alone: other axes are turned into it here
        aligning = alignment(self._rounding.axis(joint))
        aligned = frame.composed @ aligning
        rotation = self._in_body(frame.body, aligned)
        body = len(self._stretches) - 1
        if joint.type == "prismatic":
            # a slide turns nothing, so angles before and after it still add up
            stretch = self._stretches[frame.body + 1]
            self._stretches.append((*stretch, _StretchFrame(aligned, stretch[-1].exact @ rotation)))
            composed = frame.composed
        else:
            # a revolute joint turns by any angle: what comes behind it no longer adds up with what was before
            self._stretches.append((_STRAIGHT,))
            composed = aligning.T
        self.frames[joint.child] = Frame(body, composed, self._in_body(body, composed), ZERO)
        return Pose(frame.body, rotation, self._seen_from_both(rotation, frame.position))

    def inertia(self, link: Link, inertial: Inertial) -> TenVector:
        """Return the link's (m, m c, I) about its body's origin, in the body's frame (parallel-axis theorem)."""
        # about the body origin, in which M and V are linear in all ten parameters
        offset, turn = self._rounding.inertial_origin(link, inertial)
        frame = self._turned(self.frames[link.name], self._offset(self.frames[link.name], offset), turn)
        mass = exact(inertial.mass)
        center = frame.position
        tensor = frame.rotation @ self._rounding.tensor(link, inertial) @ frame.rotation.T
        tensor = tensor + mass * (center @ center * IDENTITY - np.outer(center, center))
        return (mass, *mass * center, *tensor[np.triu_indices(3)])

    def _joint_origin(self, joint: Joint) -> Frame:
        frame = self.frames[joint.parent]
        offset, turn = self._rounding.joint_origin(joint)
        return self._turned(frame, self._offset(frame, offset), turn)

    def _offset(self, frame: Frame, offset: np.ndarray) -> np.ndarray:
        return self._rounding.position(frame.position + frame.rotation @ offset)

    def _slid(self, frame: Frame, axis: np.ndarray, value: float) -> Frame:
        position = self._offset(frame, exact(value) * np.array(list(map(exact, axis.tolist()))))
        return Frame(frame.body, frame.composed, frame.rotation, position)

    def _turned(self, frame: Frame, position: np.ndarray, turn: np.ndarray | None) -> Frame:
        """Return ``frame`` turned by ``turn`` (3, 3), None for not at all, and at ``position``."""
        if turn is None:
            return Frame(frame.body, frame.composed, frame.rotation, position)
        composed = frame.composed @ turn
        return Frame(frame.body, composed, self._in_body(frame.body, composed), position)

    def _seen_from_both(self, rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Return the position of a joint without noise in its parent's frame nor, where both can be, in its own.

        An offset of (0.1, 0.1, 0) goes exactly along an axis of 45 degrees, but not along a rational one.
        """
        in_own_frame = self._rounding.position(rotation.T @ position)
        moved = self._rounding.position(rotation @ in_own_frame)
        if np.array_equal(rotation.T @ moved, in_own_frame):
            return moved
        return position

    def _in_body(self, body: int, composed: np.ndarray) -> np.ndarray:
        """Return the exact rotation in the body's frame of what is turned by ``composed`` in its stretch's.

        It is made rational in that frame of the stretch in which it then keeps most zeros seen from all of them: an
        axis of 45 degrees, no rational one, may be square to several.
        """
        stretch = self._stretches[body + 1]
        best = IDENTITY
        fewest: int | None = None
        for frame in stretch:
            candidate = frame.exact @ exact_rotation(frame.composed.T @ composed)
            lost = _zeros_lost(stretch, composed, candidate)
            if fewest is None or lost < fewest:
                best, fewest = candidate, lost
            if not lost:
                break
        rotation: np.ndarray = stretch[-1].exact.T @ best
        return rotation


def _zeros_lost(stretch: tuple[_StretchFrame, ...], composed: np.ndarray, candidate: np.ndarray) -> int:
    """Count the zeros, seen from the frames of a stretch, that a rational rotation has lost."""
    lost = 0
    for frame in stretch:
        lost += lost_zeros(frame.exact.T @ candidate, frame.composed.T @ composed)
    return lost
