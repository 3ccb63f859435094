"""Rounding of the origins and axes of a URDF to the special values that they represent, with diagnostics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from math import pi

import numpy as np

from spelgen.arm.rational import bounded, exact, rotation_from_rpy, rounded_angle
from spelgen.arm.tuning import TUNING
from spelgen.errors import Diagnostic
from spelgen.urdf.robot import Inertial, UrdfJoint, UrdfLink


@dataclass(frozen=True)
class AngleRounding:
    """Rounding of angles within ``tolerance`` [rad], and of offsets, axes and tensors; a tolerance of 0 disables it.

    ``diagnostics`` has one entry per changed origin or axis.
    """

    tolerance: float
    diagnostics: list[Diagnostic] = field(default_factory=list)

    def joint_origin(self, joint: UrdfJoint) -> tuple[np.ndarray, np.ndarray | None]:
        """Return position (3,) [m] and rotation (3, 3) of a joint in the frame of its parent; None: no rotation."""
        where = f"joint {joint.name!r} origin"
        return self._offset(joint.xyz, where, joint.line), self._rotation(joint.rpy, where, joint.line)

    def inertial_origin(self, link: UrdfLink, inertial: Inertial) -> tuple[np.ndarray, np.ndarray | None]:
        """Return position (3,) [m] and rotation (3, 3) of an inertial in the frame of its link; None: no rotation."""
        where = f"link {link.name!r} inertial origin"
        offset = self._offset(inertial.com, where, inertial.line)
        return offset, self._rotation(inertial.rpy, where, inertial.line)

    def tensor(self, link: UrdfLink, inertial: Inertial) -> np.ndarray:
        """Return the exact inertia tensor (3, 3) [kg m2]; products of inertia of the order of rounding errors are 0."""
        xx, xy, xz, yy, yz, zz = inertial.tensor
        if self.tolerance:
            # CAD programs export products of inertia of 1e-18 for symmetric parts.
            noise = TUNING.zero_noise * max(abs(xx), abs(yy), abs(zz))
            products = np.array((xy, xz, yz))
            products[np.abs(products) < noise] = 0.0
            if (xy, xz, yz) != tuple(products):
                message = f"{_vector_text((xy, xz, yz))} kg m2 is taken as {_vector_text(products)}"
                self._note("snapped-inertia", f"link {link.name!r} inertial products", inertial.line, message)
            xy, xz, yz = products.tolist()
        rows = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
        tensor: np.ndarray = np.vectorize(exact, otypes=[object])(rows)
        return tensor

    def axis(self, joint: UrdfJoint) -> np.ndarray:
        """Return the axis of a joint as a unit vector in the frame of the joint, (3,)."""
        # axes in URDFs often have other lengths, such as 0 0 -1.0001
        unit: np.ndarray = np.array(joint.axis) / np.linalg.norm(joint.axis)
        if self.tolerance == 0.0:
            return unit
        rounded = np.where(np.abs(unit) < TUNING.axis_noise, 0.0, unit)
        # A unit vector again, as components below the noise were removed.
        rounded /= np.linalg.norm(rounded)
        if np.abs(rounded - unit).max() > TUNING.notable:
            message = f"{_vector_text(joint.axis)} is taken as {_vector_text(rounded)}"
            self._note("snapped-axis", f"joint {joint.name!r} axis", joint.line, message)
        return rounded

    def angle(self, angle: float) -> float:
        """Return a rounded angle [rad] without a diagnostic, such as the constant offset of a mimic joint."""
        return rounded_angle(angle, self.tolerance)

    def position(self, vector: np.ndarray) -> np.ndarray:
        """Return a composed position (3,) [m] without the noise of rounded rotations."""
        noise = 0.0
        if self.tolerance:
            noise = TUNING.offset_noise
        rounded = [bounded(value) if abs(value) >= noise else Fraction(0) for value in vector]
        return np.array(rounded)

    def _offset(self, offset: Sequence[float], where: str, line: int) -> np.ndarray:
        """Return an offset (3,) [m], rounded."""
        written = np.array(list(map(exact, offset)))
        rounded = self.position(written)
        if (rounded != written).any():
            message = f"{_vector_text(offset)} m is taken as {_vector_text(rounded)}"
            self._note("snapped-offset", where, line, message)
        return rounded

    def _rotation(self, rpy: Sequence[float], where: str, line: int) -> np.ndarray | None:
        """Return the rotation (3, 3) of rounded roll, pitch and yaw [rad]; None for the identity."""
        if not any(rpy):
            return None
        rounded = list(map(self.angle, rpy))
        changes = []
        for angle, special in zip(rpy, rounded, strict=True):
            if abs(special - angle) > TUNING.notable:
                changes.append(f"{angle:.10g} is taken as {_in_pi(special)}")
        if changes:
            self._note("snapped-angle", where, line, "; ".join(changes))
        # most origins have no rotation: None avoids a product of exact matrices
        if not any(rounded):
            return None
        return rotation_from_rpy(rounded)

    def _note(self, code: str, where: str, line: int, message: str) -> None:
        self.diagnostics.append(Diagnostic("info", code, where, line, message))


def _in_pi(angle: float) -> str:
    """Return a rounded angle as a multiple of pi: "-3 pi/4"."""
    multiple = Fraction(angle / pi).limit_denominator(120)  # a common multiple of the divisors
    if multiple == 0:
        return "0"
    text = "pi"
    if abs(multiple.numerator) > 1:
        text = f"{abs(multiple.numerator)} pi"
    if multiple < 0:
        text = f"-{text}"
    if multiple.denominator > 1:
        text = f"{text}/{multiple.denominator}"
    return text


def _vector_text(values: Sequence[float] | np.ndarray) -> str:
    """Return a vector (3,) as text with six digits."""
    return "(" + ", ".join(f"{float(value):.6g}" for value in values) + ")"
