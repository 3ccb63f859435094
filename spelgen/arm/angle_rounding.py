"""The file's origins and axes, rounded where they mean a special value, and what to tell about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from math import pi

import numpy as np

from spelgen.arm.rational import Tensor, Vector, bounded, exact, rotation_from_rpy, rounded_angle
from spelgen.errors import Diagnostic
from spelgen.urdf.robot import Inertial, Joint, Link

OFFSET_NOISE = 1e-9
AXIS_NOISE = 1e-3
# of a product of inertia, as a fraction of the largest moment: what rounding in CAD programs leaves
TENSOR_NOISE = 1e-12
_TOLD = 1e-9


@dataclass(frozen=True)
class AngleRounding:
    """Reads special values out of rounded ones: angles within ``tolerance`` [rad], offsets, axes, tensors.

    A tolerance of 0 switches all of it off. What changed is gathered in ``diagnostics``, once per origin or
    axis.
    """

    tolerance: float
    diagnostics: list[Diagnostic] = field(default_factory=list)

    def joint_origin(self, joint: Joint) -> tuple[Vector, np.ndarray | None]:
        """Position [m] and rotation (3, 3) of a joint in its parent link's frame; None for no rotation."""
        where = f"joint {joint.name!r} origin"
        return self._offset(joint.xyz, where, joint.line), self._rotation(joint.rpy, where, joint.line)

    def inertial_origin(self, link: Link, inertial: Inertial) -> tuple[Vector, np.ndarray | None]:
        """Position [m] and rotation (3, 3) of an inertial frame in its link's frame; None for no rotation."""
        where = f"link {link.name!r} inertial origin"
        offset = self._offset(inertial.com, where, inertial.line)
        return offset, self._rotation(inertial.rpy, where, inertial.line)

    def tensor(self, link: Link, inertial: Inertial) -> Tensor:
        """The inertia tensor [kg m2], without products of inertia that are a computation's rounding error."""
        xx, xy, xz, yy, yz, zz = inertial.tensor
        noise = TENSOR_NOISE * max(abs(xx), abs(yy), abs(zz)) if self.tolerance else 0.0
        kept_xy, kept_xz, kept_yz = (0.0 if abs(value) < noise else value for value in (xy, xz, yz))
        if (kept_xy, kept_xz, kept_yz) != (xy, xz, yz):
            told = f"{_listed((xy, xz, yz))} kg m2 is taken as {_listed((kept_xy, kept_xz, kept_yz))}"
            where = f"link {link.name!r} inertial products"
            self._tell("snapped-inertia", where, inertial.line, told)
        return exact(xx), exact(kept_xy), exact(kept_xz), exact(yy), exact(kept_yz), exact(zz)

    def axis(self, joint: Joint) -> np.ndarray:
        """The joint's axis as a unit vector in the joint's frame, (3,)."""
        unit = np.array(joint.axis) / np.linalg.norm(joint.axis)
        if self.tolerance == 0.0:
            return unit
        kept = np.where(np.abs(unit) < AXIS_NOISE, 0.0, unit)
        kept /= np.linalg.norm(kept)
        if np.abs(kept - unit).max() > _TOLD:
            told = f"{_listed(joint.axis)} is taken as {_listed(kept)}"
            self._tell("snapped-axis", f"joint {joint.name!r} axis", joint.line, told)
        return kept

    def angle(self, angle: float) -> float:
        """An angle [rad] that no diagnostic is worth: a constant offset of a mimic joint."""
        return rounded_angle(angle, self.tolerance)

    def position(self, vector: Vector) -> Vector:
        """A composed position [m] without the noise that rounded rotations leave in it."""
        noise = OFFSET_NOISE if self.tolerance else 0.0
        x, y, z = (bounded(value) if abs(value) >= noise else Fraction(0) for value in vector)
        return x, y, z

    def _offset(self, offset: Sequence[float], where: str, line: int) -> Vector:
        x, y, z = (exact(value) for value in offset)
        kept = self.position((x, y, z))
        if kept != (x, y, z):
            told = f"{_listed(offset)} m is taken as {_listed([float(value) for value in kept])}"
            self._tell("snapped-offset", where, line, told)
        return kept

    def _rotation(self, rpy: Sequence[float], where: str, line: int) -> np.ndarray | None:
        if not any(rpy):
            return None
        rounded = [rounded_angle(angle, self.tolerance) for angle in rpy]
        told = [
            f"{before:.10g} is taken as {_in_pi(after)}"
            for before, after in zip(rpy, rounded, strict=True)
            if abs(after - before) > _TOLD
        ]
        if told:
            self._tell("snapped-angle", where, line, "; ".join(told))
        return rotation_from_rpy(rounded) if any(rounded) else None

    def _tell(self, code: str, where: str, line: int, message: str) -> None:
        self.diagnostics.append(Diagnostic("info", code, where, line, message))


def _in_pi(angle: float) -> str:
    """An angle as a multiple of pi, which a rounded one is: "-3 pi/4"."""
    turns = Fraction(angle / pi).limit_denominator(120)
    if turns == 0:
        return "0"
    sign, count = "-" if turns < 0 else "", abs(turns.numerator)
    told = f"{sign}{count} pi" if count > 1 else f"{sign}pi"
    return told if turns.denominator == 1 else f"{told}/{turns.denominator}"


def _listed(values: Sequence[float] | np.ndarray) -> str:
    return "(" + ", ".join(f"{float(value):.6g}" for value in values) + ")"
