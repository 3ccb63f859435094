"""Exact poses of joints and links at zero position, and inertias in the frame of their body.

The rotation matrix of a decimal angle is not rational. All rotations between two successive revolute joints (a segment)
are therefore composed in float64, and the product is approximated by a rational orthogonal matrix once. For example,
45 degrees, a prismatic joint and another 45 degrees give exactly 90 degrees.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from math import pi
from typing import NamedTuple

import numpy as np

from spelgen.arm.rational import (
    IDENTITY,
    TUNING,
    ZERO,
    alignment,
    bounded,
    exact,
    exact_rotation,
    lost_zeros,
    rotation_about,
    rotation_from_rpy,
    rounded_angle,
)
from spelgen.errors import Diagnostic
from spelgen.urdf.robot import Inertial, UrdfJoint, UrdfLink

TenVector = tuple[Fraction, ...]


@dataclass(frozen=True)
class AngleRounding:
    """Replacement of rounded numbers in a URDF, such as 1.5708, by the exact values that are meant, such as pi/2.

    tolerance: largest change of an angle to a multiple of pi/2 [rad]. Offsets, axes and inertia tensors are rounded
    with tolerances of their own. A tolerance of 0 disables all rounding. diagnostics: one entry per changed position,
    rotation, axis or tensor.
    """

    tolerance: float
    diagnostics: list[Diagnostic] = field(default_factory=list)

    @property
    def rotation_error(self) -> float:
        """Largest permitted error of the rational approximation of a rotation [rad]."""
        # If rounding is disabled, the rational approximation must not round either. For example, 1.57079632679 differs
        # from pi/2 by 5e-12: with a permitted error of 1e-11, the rotation would become a quarter turn.
        return TUNING.rotation_error if self.tolerance else 1e-15

    def origin(
        self, xyz: Sequence[float], rpy: Sequence[float], where: str, line: int
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the position (3,) [m] and rotation (3, 3) of an <origin>; the rotation is None if all angles are zero.

        xyz, rpy: attributes of the element [m, rad]. where, line: name and line of the element in diagnostics.
        """
        written = np.array(list(map(exact, xyz)))
        offset = self.position(written)
        if (offset != written).any():
            self._note("snapped-offset", where, line, f"{_text(xyz)} m is taken as {_text(offset)}")
        angles = [rounded_angle(angle, self.tolerance) for angle in rpy]
        changes = []
        for angle, special in zip(rpy, angles, strict=True):
            if abs(special - angle) > TUNING.notable:
                changes.append(f"{angle:.10g} is taken as {_in_pi(special)}")
        if changes:
            self._note("snapped-angle", where, line, "; ".join(changes))
        # Most origins have no rotation. None then indicates that a slow product of exact matrices can be omitted.
        return offset, rotation_from_rpy(angles) if any(angles) else None

    def tensor(self, link: UrdfLink, inertial: Inertial) -> np.ndarray:
        """Return the inertia tensor (3, 3) [kg m2] in the inertial frame; each number of the URDF is an exact fraction.

        Unless rounding is disabled, products of inertia below 1e-12 times the largest moment of inertia are first set
        to 0.
        """
        xx, xy, xz, yy, yz, zz = inertial.tensor
        if self.tolerance:
            # CAD programs export products of inertia such as 1e-18 in place of 0 for symmetric parts.
            noise = TUNING.zero_noise * max(abs(xx), abs(yy), abs(zz))
            products = [0.0 if abs(product) < noise else product for product in (xy, xz, yz)]
            if [xy, xz, yz] != products:
                message = f"{_text((xy, xz, yz))} kg m2 is taken as {_text(products)}"
                self._note("snapped-inertia", f"link {link.name!r} inertial products", inertial.line, message)
            xy, xz, yz = products
        rows = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
        return np.asarray(np.vectorize(exact, otypes=[object])(rows))

    def axis(self, joint: UrdfJoint) -> np.ndarray:
        """Return the axis of a joint as a unit vector in the frame of the joint, (3,)."""
        # Axes in URDFs are often not unit vectors, such as 0 0 -1.0001.
        unit: np.ndarray = np.array(joint.axis) / np.linalg.norm(joint.axis)
        if self.tolerance == 0.0:
            return unit
        # Components of the unit vector below 1e-3 are set to 0: some CAD exporters print three digits, so that a
        # component of 0.001 may be a rounding error.
        rounded = np.where(np.abs(unit) < 1e-3, 0.0, unit)
        # The axis is normalised again, because components were set to 0.
        rounded /= np.linalg.norm(rounded)
        if np.abs(rounded - unit).max() > TUNING.notable:
            message = f"{_text(joint.axis)} is taken as {_text(rounded)}"
            self._note("snapped-axis", f"joint {joint.name!r} axis", joint.line, message)
        return rounded

    def position(self, vector: np.ndarray) -> np.ndarray:
        """Return the position ``vector`` (3,) [m]; components below 1 nm, rounding errors of rotations, become 0."""
        # [m] Smaller components are rounding errors, which composed rotations cause in positions.
        noise = 1e-9 if self.tolerance else 0.0
        return np.array([bounded(value) if abs(value) >= noise else Fraction(0) for value in vector])

    def _note(self, code: str, where: str, line: int, message: str) -> None:
        self.diagnostics.append(Diagnostic("info", code, where, line, message))


def _in_pi(angle: float) -> str:
    """Return a rounded angle [rad] as text for a message, as a multiple of pi: "-3 pi/4"."""
    # 120 is a common multiple of 2, 5, 8 and 12, the divisors of pi of all special angles (see `rounded_angle`).
    multiple = Fraction(angle / pi).limit_denominator(120)
    numerator, denominator = multiple.as_integer_ratio()
    if not numerator:
        return "0"
    text = {1: "pi", -1: "-pi"}.get(numerator, f"{numerator} pi")
    return text if denominator == 1 else f"{text}/{denominator}"


def _text(values: Sequence[float] | np.ndarray) -> str:
    """Return a vector (3,) as text for a message, with six significant digits per component."""
    return "(" + ", ".join(f"{float(value):.6g}" for value in values) + ")"


class Frame(NamedTuple):
    """The pose of the frame of a link at zero position.

    Attributes:
        body: index of the body of the link, -1 for the root link.
        composed: float64 rotation (3, 3) of the link relative to the start of its segment. A segment starts at the root
            or at a body with a revolute joint. A prismatic joint does not rotate: its body continues the segment. All
            rotations within a segment are therefore constant.
        rotation: rotation (3, 3) of the link in the frame of its body, an exactly orthogonal matrix of fractions. It is
            a rational approximation of `composed`, converted to the frame of the body (see `Placement._in_body`).
        position: position (3,) [m] of the link in the frame of its body, as fractions.
    """

    body: int
    composed: np.ndarray
    rotation: np.ndarray
    position: np.ndarray


_Rotation = tuple[np.ndarray, np.ndarray]
"""Rotation (3, 3) in the frame of the last body with a revolute joint, in float64 and as rational numbers."""


class Placement:
    """Poses of links, added from the root outwards: each joint is locked (`lock`) or starts a new body (`move`)."""

    def __init__(self, root: str, rounding: AngleRounding) -> None:
        self.frames = {root: Frame(-1, np.eye(3), IDENTITY, ZERO)}
        self._rounding = rounding
        # A segment is a part of the tree within which all rotations are constant. It starts at the root (body -1) or at
        # a body with a revolute joint; a prismatic joint does not rotate, so its body continues the segment.
        # `_segments[body + 1]` is a tuple with one pair for each body from the start of the segment to this body: the
        # rotation of the body relative to the start of the segment in float64, and its rational approximation.
        self._segments: list[tuple[_Rotation, ...]] = [((np.eye(3), IDENTITY),)]

    def lock(self, joint: UrdfJoint, value: float) -> None:
        """Add to ``frames`` the pose of the child link of a joint that is locked at the position ``value`` [rad, m]."""
        frame = self._joint_origin(joint)
        if value:
            axis = self._rounding.axis(joint)
            offset, turn = ZERO, None
            if joint.type == "prismatic":
                offset = exact(value) * np.array(list(map(exact, axis.tolist())))
            else:
                # A revolute joint that is locked at a nonzero angle rotates the frames of all later links by this
                # angle.
                turn = rotation_about(axis, rounded_angle(value, self._rounding.tolerance))
            frame = self._displaced(frame, offset, turn)
        self.frames[joint.child] = frame

    def move(self, joint: UrdfJoint) -> tuple[int, np.ndarray, np.ndarray]:
        """Add to ``frames`` the pose of the child link of a moving joint; the link starts a new body.

        Bodies are numbered in the order of the calls.

        Returns:
            The index of the parent body, and the rotation (3, 3) and position (3,) [m] of the joint's frame in the
            frame of the parent body. The +z axis of the joint's frame is the axis of the joint.
        """
        frame = self._joint_origin(joint)
        # `structure.recursion` requires that each joint moves about or along z.
        aligning = alignment(self._rounding.axis(joint))
        aligned = frame.composed @ aligning
        rotation = self._in_body(frame.body, aligned)
        body = len(self._segments) - 1
        if joint.type == "prismatic":
            # A prismatic joint does not rotate, so its body continues the segment of its parent (see `_segments`). The
            # product of the rotations before and after the joint is constant. It gets one rational approximation,
            # because the product of two approximations would not have its zeros.
            segment = self._segments[frame.body + 1]
            self._segments.append((*segment, (aligned, segment[-1][1] @ rotation)))
            composed = frame.composed
        else:
            # The rotation across a revolute joint is not constant: a new segment begins.
            self._segments.append(((np.eye(3), IDENTITY),))
            composed = aligning.T
        self.frames[joint.child] = Frame(body, composed, self._in_body(body, composed), ZERO)
        return frame.body, rotation, self._without_rounding_errors(rotation, frame.position)

    def inertia(self, link: UrdfLink, inertial: Inertial) -> TenVector:
        """Return the inertial parameters (m, m c, I) of a link in the frame of its body, (10,) [kg, kg m, kg m2].

        m: mass; c: center of mass; I: inertia about the origin of the frame, by the parallel-axis theorem.
        """
        where = f"link {link.name!r} inertial origin"
        origin = self._rounding.origin(inertial.com, inertial.rpy, where, inertial.line)
        frame = self._displaced(self.frames[link.name], *origin)
        mass, center = exact(inertial.mass), frame.position
        tensor = frame.rotation @ self._rounding.tensor(link, inertial) @ frame.rotation.T
        tensor = tensor + mass * (center @ center * IDENTITY - np.outer(center, center))
        return (mass, *mass * center, *tensor[np.triu_indices(3)])

    def _joint_origin(self, joint: UrdfJoint) -> Frame:
        origin = self._rounding.origin(joint.xyz, joint.rpy, f"joint {joint.name!r} origin", joint.line)
        return self._displaced(self.frames[joint.parent], *origin)

    def _displaced(self, frame: Frame, offset: np.ndarray, turn: np.ndarray | None) -> Frame:
        """Return a new frame: ``frame``, translated by ``offset`` (3,) [m] and then rotated by ``turn`` (3, 3).

        offset and turn are relative to the axes of ``frame``. turn: None for no rotation.
        """
        position = self._rounding.position(frame.position + frame.rotation @ offset)
        if turn is None:
            return Frame(frame.body, frame.composed, frame.rotation, position)
        composed = frame.composed @ turn
        return Frame(frame.body, composed, self._in_body(frame.body, composed), position)

    def _without_rounding_errors(self, rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Return the position (3,) [m] of a joint in its parent body, with tiny components in both frames set to 0.

        The two frames are the joint's and the parent body's. The caller has set tiny components of ``position`` in the
        body's frame to 0. Tiny components in the joint's frame are also due to rounding. Example: an offset of
        (0.1, 0.1, 0) along an axis at 45 degrees is not exactly parallel to the rational approximation of the axis.
        If the components cannot be 0 in both frames at once, ``position`` is returned unchanged.

        Args:
            rotation: exact rotation (3, 3) of the joint's frame in the frame of the parent body.
            position: exact position (3,) [m] in the frame of the parent body.
        """
        in_own_frame = self._rounding.position(rotation.T @ position)
        # `in_own_frame` is the position in the joint's frame, with tiny components set to 0. `moved` is this position
        # in the body's frame, again with tiny components set to 0: a rounding error in either frame would make a zero
        # entry of M nonzero. `moved` is returned only if the second step preserves the zeros in the joint's frame.
        moved = self._rounding.position(rotation @ in_own_frame)
        return moved if np.array_equal(rotation.T @ moved, in_own_frame) else position

    def _in_body(self, body: int, composed: np.ndarray) -> np.ndarray:
        """Return the rotation (3, 3) of a frame relative to a body as fractions, approximated from float64.

        A zero element of a rotation means that an axis of the frame is normal to an axis of the body. The rotation of
        the frame may have zeros relative to each body of the segment (the bodies since the last revolute joint, or
        since the root). A rational approximation preserves only the zeros of the rotation that is approximated. The
        rotation is therefore approximated relative to each body of the segment. The approximation that preserves most
        zeros is converted to the frame of ``body`` and returned.

        Args:
            body: index of the body, -1 for the root link.
            composed: float64 rotation (3, 3) of the frame relative to the start of the segment that contains the body.
        """
        segment = self._segments[body + 1]
        candidates: list[tuple[int, int, np.ndarray]] = []
        for turned, rational in segment:
            candidate = rational @ exact_rotation(turned.T @ composed, self._rounding.rotation_error)
            lost = sum(lost_zeros(y.T @ candidate, x.T @ composed) for x, y in segment)
            candidates.append((lost, len(candidates), candidate))
            if not lost:
                break
        return np.asarray(segment[-1][1].T @ min(candidates)[2])
