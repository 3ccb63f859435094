"""Round a file's origins and axes where they mean a special value, and say so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from math import pi

import numpy as np

from spelgen.arm.rational import bounded, exact, rotation_from_rpy, rounded_angle
from spelgen.arm.tuning import TUNING
from spelgen.errors import Diagnostic
from spelgen.urdf.robot import Inertial, Joint, Link


@dataclass(frozen=True)
class AngleRounding:
    """Read special values out of rounded ones: angles within ``tolerance`` [rad], offsets, axes, tensors.

    A tolerance of 0 switches all of it off. What changed is gathered in ``diagnostics``, once per origin or
    axis.
    """

    tolerance: float
    diagnostics: list[Diagnostic] = field(default_factory=list)

    def joint_origin(self, joint: Joint) -> tuple[np.ndarray, np.ndarray | None]:
        """Return position [m] and rotation (3, 3) of a joint in its parent link's frame; None for no rotation."""
        where = f"joint {joint.name!r} origin"
        return self._offset(joint.xyz, where, joint.line), self._rotation(joint.rpy, where, joint.line)

    def inertial_origin(self, link: Link, inertial: Inertial) -> tuple[np.ndarray, np.ndarray | None]:
        """Return position [m] and rotation (3, 3) of an inertial in its link's frame; None for no rotation."""
        where = f"link {link.name!r} inertial origin"
        offset = self._offset(inertial.com, where, inertial.line)
        return offset, self._rotation(inertial.rpy, where, inertial.line)

    def tensor(self, link: Link, inertial: Inertial) -> np.ndarray:
        """Return the exact tensor (3, 3) [kg m2], without products of inertia that are a computation's rounding."""
        xx, xy, xz, yy, yz, zz = inertial.tensor
        if self.tolerance:
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

    def axis(self, joint: Joint) -> np.ndarray:
        """Return the joint's axis as a unit vector in the joint's frame, (3,)."""
        # axes in files are often longer than one, 0 0 -1.0001 for example
        unit: np.ndarray = np.array(joint.axis) / np.linalg.norm(joint.axis)
        if self.tolerance == 0.0:
            return unit
        rounded = np.where(np.abs(unit) < TUNING.axis_noise, 0.0, unit)
        rounded /= np.linalg.norm(rounded)
        if np.abs(rounded - unit).max() > TUNING.notable:
            message = f"{_vector_text(joint.axis)} is taken as {_vector_text(rounded)}"
            self._note("snapped-axis", f"joint {joint.name!r} axis", joint.line, message)
        return rounded

    def angle(self, angle: float) -> float:
        """Return an angle [rad] whose rounding is not worth a diagnostic: a constant offset of a mimic joint."""
        return rounded_angle(angle, self.tolerance)

    def position(self, vector: np.ndarray) -> np.ndarray:
        """Return a composed position [m] without the noise that rounded rotations leave in it."""
        noise = 0.0
        if self.tolerance:
            noise = TUNING.offset_noise
        rounded = [bounded(value) if abs(value) >= noise else Fraction(0) for value in vector]
        return np.array(rounded)

    def _offset(self, offset: Sequence[float], where: str, line: int) -> np.ndarray:
        written = np.array(list(map(exact, offset)))
        rounded = self.position(written)
        if (rounded != written).any():
            message = f"{_vector_text(offset)} m is taken as {_vector_text(rounded)}"
            self._note("snapped-offset", where, line, message)
        return rounded

    def _rotation(self, rpy: Sequence[float], where: str, line: int) -> np.ndarray | None:
        if not any(rpy):
            return None
        rounded = list(map(self.angle, rpy))
        changes = []
        for angle, special in zip(rpy, rounded, strict=True):
            if abs(special - angle) > TUNING.notable:
                changes.append(f"{angle:.10g} is taken as {_in_pi(special)}")
        if changes:
            self._note("snapped-angle", where, line, "; ".join(changes))
        # most origins do not turn: None saves a product of exact matrices
        if not any(rounded):
            return None
        return rotation_from_rpy(rounded)

    def _note(self, code: str, where: str, line: int, message: str) -> None:
        self.diagnostics.append(Diagnostic("info", code, where, line, message))


def _in_pi(angle: float) -> str:
    """Return an angle as a multiple of pi, which a rounded one is: "-3 pi/4"."""
    turns = Fraction(angle / pi).limit_denominator(120)  # a multiple of all divisors that are rounded to
    if turns == 0:
        return "0"
    text = "pi"
    if abs(turns.numerator) > 1:
        text = f"{abs(turns.numerator)} pi"
    if turns < 0:
        text = f"-{text}"
    if turns.denominator > 1:
        text = f"{text}/{turns.denominator}"
    return text


def _vector_text(values: Sequence[float] | np.ndarray) -> str:
    return "(" + ", ".join(f"{float(value):.6g}" for value in values) + ")"
