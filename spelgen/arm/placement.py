"""Exact poses of joints and links at zero position, and inertias in the frame of their body.

A rotation composed of decimal angles is not rational. Rotations are therefore composed in float64 between revolute
joints (a segment), and approximated by a rational matrix once: 45 degrees, a prismatic joint and another 45 degrees are
exactly 90, and every rotation is exactly orthogonal.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from spelgen.arm.angle_rounding import AngleRounding
from spelgen.arm.rational import IDENTITY, ZERO, alignment, exact, exact_rotation, lost_zeros, rotation_about
from spelgen.urdf.robot import Inertial, UrdfJoint, UrdfLink

TenVector = tuple[Fraction, ...]


@dataclass(frozen=True, eq=False)
class Frame:
    """The frame of a link at zero position in the frame of its body (-1: the root link).

    composed: float64 rotation (3, 3) in the frame of the last revolute body before the link. rotation: exact rotation
    (3, 3) in the frame of the body, which differs if there are prismatic bodies between the two.
    """

    body: int
    composed: np.ndarray
    rotation: np.ndarray
    position: np.ndarray


@dataclass(frozen=True, eq=False)
class _SegmentFrame:
    """The rotation of a frame in the frame of the last revolute body before it, (3, 3), in float64 and rational."""

    composed: np.ndarray
    exact: np.ndarray


_UNROTATED = _SegmentFrame(np.eye(3), IDENTITY)


@dataclass(frozen=True, eq=False)
class Pose:
    """The frame of a joint, with +z along its axis, in the frame of the body ``parent``."""

    parent: int
    rotation: np.ndarray
    translation: np.ndarray


class Placement:
    """Poses of links from the root outwards: a joint is locked, or starts a new body."""

    def __init__(self, root: str, rounding: AngleRounding) -> None:
        self.frames = {root: Frame(-1, np.eye(3), IDENTITY, ZERO)}
        self._rounding = rounding
        # per body, the frames from the last revolute body (the body itself if it is revolute) to the body
        self._segments: list[tuple[_SegmentFrame, ...]] = [(_UNROTATED,)]

    def lock(self, joint: UrdfJoint, value: float) -> None:
        """Add the child of a joint that is locked at ``value`` [rad, m]."""
        frame = self._joint_origin(joint)
        if value and joint.type == "prismatic":
            axis = np.array(list(map(exact, self._rounding.axis(joint).tolist())))
            frame = self._turned(frame, self._offset(frame, exact(value) * axis), None)
        elif value:
            # A revolute joint locked off zero turns all later frames by a constant angle.
            turn = rotation_about(self._rounding.axis(joint), self._rounding.angle(value))
            frame = self._turned(frame, frame.position, turn)
        self.frames[joint.child] = frame

    def move(self, joint: UrdfJoint) -> Pose:
        """Add a moving joint and its child, which start a body; bodies are numbered in the order of the calls."""
        frame = self._joint_origin(joint)
        # in the recursion all axes are z axes
        aligning = alignment(self._rounding.axis(joint))
        aligned = frame.composed @ aligning
        rotation = self._in_body(frame.body, aligned)
        body = len(self._segments) - 1
        if joint.type == "prismatic":
            # a prismatic joint does not rotate: rotations before and behind it compose to a constant rotation
            segment = self._segments[frame.body + 1]
            self._segments.append((*segment, _SegmentFrame(aligned, segment[-1].exact @ rotation)))
            composed = frame.composed
        else:
            # a revolute joint has any angle: a new segment begins
            self._segments.append((_UNROTATED,))
            composed = aligning.T
        self.frames[joint.child] = Frame(body, composed, self._in_body(body, composed), ZERO)
        return Pose(frame.body, rotation, self._seen_from_both(rotation, frame.position))

    def inertia(self, link: UrdfLink, inertial: Inertial) -> TenVector:
        """Return (m, m c, I) of a link about the origin of its body, in the frame of the body (parallel-axis theorem).

        M and V are linear in these parameters.
        """
        offset, turn = self._rounding.inertial_origin(link, inertial)
        frame = self._turned(self.frames[link.name], self._offset(self.frames[link.name], offset), turn)
        mass = exact(inertial.mass)
        center = frame.position
        tensor = frame.rotation @ self._rounding.tensor(link, inertial) @ frame.rotation.T
        tensor = tensor + mass * (center @ center * IDENTITY - np.outer(center, center))
        return (mass, *mass * center, *tensor[np.triu_indices(3)])

    def _joint_origin(self, joint: UrdfJoint) -> Frame:
        frame = self.frames[joint.parent]
        offset, turn = self._rounding.joint_origin(joint)
        return self._turned(frame, self._offset(frame, offset), turn)

    def _offset(self, frame: Frame, offset: np.ndarray) -> np.ndarray:
        """Return the position (3,) [m] at ``offset`` (3,) in ``frame``, in the frame of the body."""
        return self._rounding.position(frame.position + frame.rotation @ offset)

    def _turned(self, frame: Frame, position: np.ndarray, turn: np.ndarray | None) -> Frame:
        """Return ``frame`` rotated by ``turn`` (3, 3), if not None, with its origin at ``position`` (3,)."""
        if turn is None:
            return Frame(frame.body, frame.composed, frame.rotation, position)
        composed = frame.composed @ turn
        return Frame(frame.body, composed, self._in_body(frame.body, composed), position)

    def _seen_from_both(self, rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Return the position (3,) of a joint, rounded in the frame of its parent and, if both agree, in its own
        frame.

        An offset of (0.1, 0.1, 0) is parallel to an axis at 45 degrees, but not to its rational approximation.
        """
        in_own_frame = self._rounding.position(rotation.T @ position)
        # An offset without a component along an axis may be a zero of M: it is kept if both frames agree.
        moved = self._rounding.position(rotation @ in_own_frame)
        if np.array_equal(rotation.T @ moved, in_own_frame):
            return moved
        return position

    def _in_body(self, body: int, composed: np.ndarray) -> np.ndarray:
        """Return the exact rotation (3, 3) in the frame of a body for a rotation ``composed`` (3, 3) in its segment.

        The rational approximation is made in the frame of the segment for which most zeros are preserved in all frames
        of the segment: an axis at 45 degrees, which is not rational, may be normal to several other axes.
        """
        segment = self._segments[body + 1]
        best = IDENTITY
        min_lost: int | None = None
        for frame in segment:
            candidate = frame.exact @ exact_rotation(frame.composed.T @ composed)
            lost = sum(lost_zeros(x.exact.T @ candidate, x.composed.T @ composed) for x in segment)
            if min_lost is None or lost < min_lost:
                best, min_lost = candidate, lost
            if not lost:
                break
        rotation: np.ndarray = segment[-1].exact.T @ best
        return rotation
