"""How the axes of an arm's joints lie to each other however it moves, and how the last body is balanced.

"Always" is tested exactly, at random rational configurations: a relation that does not always hold fails at
one of them but for odds below 1e-9 (Schwartz 1980, Zippel 1979).
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from fractions import Fraction
from functools import cached_property

from spelgen.arm.arm import Arm
from spelgen.arm.rational import IDENTITY, ZERO, Matrix, Vector, product, rotated, summed

_CONFIGURATIONS = 2
_GRID = 10**6


def is_plain(arm: Arm) -> bool:
    """Whether the bodies are one chain, each with a coordinate of its own."""
    return all(
        body.parent == index - 1 and body.coordinate == index and body.multiplier == 1
        for index, body in enumerate(arm.bodies)
    )


class Axes:
    """The axes of a plain arm's joints; all questions are whether something holds at every configuration."""

    def __init__(self, arm: Arm):
        self.arm = arm
        self.slides = [body.kind == "prismatic" for body in arm.bodies]
        generator = random.Random(0)
        self._placed = [_place(arm, generator) for _ in range(_CONFIGURATIONS)]

    def parallel(self, a: int, b: int) -> bool:
        return all(_cross(axes[a], axes[b]) == ZERO for axes, _ in self._placed)

    def perpendicular(self, a: int, b: int) -> bool:
        return all(_dot(axes[a], axes[b]) == 0 for axes, _ in self._placed)

    def fixed_angle(self, a: int, b: int) -> bool:
        return len({_dot(axes[a], axes[b]) for axes, _ in self._placed}) == 1

    def same_line(self, a: int, b: int) -> bool:
        return self.parallel(a, b) and all(
            _cross(_difference(at[a], at[b]), axes[a]) == ZERO for axes, at in self._placed
        )

    def opposed(self, a: int, b: int) -> bool:
        """Whether the two point against each other, for axes that are always parallel."""
        axes, _ = self._placed[0]
        return _dot(axes[a], axes[b]) < 0

    def move_alike(self, a: int, b: int) -> bool:
        """Whether unit rates of the two joints give the same velocity field, or opposite ones."""
        if self.slides[a] != self.slides[b]:
            return False
        return self.parallel(a, b) if self.slides[a] else self.same_line(a, b)

    def commute(self, a: int, b: int) -> bool:
        """Whether moving one joint leaves the other's axis where it was."""
        if self.slides[a] and self.slides[b]:
            return True
        return self.parallel(a, b) if self.slides[a] or self.slides[b] else self.same_line(a, b)

    def keep_offset(self, slider: int, turner: int) -> bool:
        """Whether no joint moves the mass behind ``slider`` across the plane of the two directions."""
        if not all(self.slides[joint] for joint in range(turner + 1, slider)):
            return False  # a turn between the two may turn the plane
        moving = [joint for joint in range(turner + 1, len(self.slides)) if joint != slider]
        for axes, _ in self._placed:
            normal = _cross(axes[slider], axes[turner])
            for joint in moving:
                if _dot(axes[joint], normal) if self.slides[joint] else _cross(axes[joint], normal) != ZERO:
                    return False
        return True

    @cached_property
    def centred(self) -> bool:
        """Whether the centre of mass of the last body, as the URDF has it, lies on its joint's axis."""
        return not any(self._last_inertia[1:3])

    @cached_property
    def balanced(self) -> bool:
        """Whether the last joint's axis also is a principal axis of inertia: it turns without shaking."""
        return self.centred and not any((self._last_inertia[6], self._last_inertia[8]))

    @cached_property
    def symmetric(self) -> bool:
        """Whether the last body has the same inertia however its joint turns."""
        return self.balanced and self._last_inertia[4] == self._last_inertia[7] and not self._last_inertia[5]

    @cached_property
    def without_inertia(self) -> bool:
        """Whether it has no moment of inertia about the last joint's axis."""
        return not self._last_inertia[9]

    @cached_property
    def _last_inertia(self) -> Sequence[Fraction]:
        # of a body that slides nothing here is said: these ones are neither centred nor balanced
        body = self.arm.bodies[-1]
        turns = body.inertia is not None and body.kind == "revolute"
        return body.inertia if turns and body.inertia is not None else (Fraction(1),) * 10

    def along_gravity(self, joint: int) -> bool:
        return all(_cross(axes[joint], self.arm.gravity) == ZERO for axes, _ in self._placed)

    def level(self, joint: int) -> bool:
        return all(_dot(axes[joint], self.arm.gravity) == 0 for axes, _ in self._placed)

    def lifts_nothing(self, joint: int) -> bool:
        return self.level(joint) if self.slides[joint] else self.along_gravity(joint)


def _place(arm: Arm, generator: random.Random) -> tuple[list[Vector], list[Vector]]:
    """Axes and origins of a plain arm's joints in the root's frame, at a random rational configuration."""
    axes, origins = [], []
    rotation, origin = IDENTITY, ZERO
    for body in arm.bodies:
        origin = summed(origin, rotated(rotation, body.translation))
        rotation = product(rotation, body.rotation)
        axis = (rotation[0][2], rotation[1][2], rotation[2][2])
        axes.append(axis)
        origins.append(origin)
        t = Fraction(generator.randrange(1, _GRID), generator.randrange(1, _GRID))
        if body.kind == "prismatic":
            x, y, z = (t * component for component in axis)
            origin = summed(origin, (x, y, z))
        else:
            rotation = product(rotation, _turn(t))
    return axes, origins


def _turn(t: Fraction) -> Matrix:
    """The rotation about z by twice the angle whose tangent is ``t``."""
    c, s = (1 - t * t) / (1 + t * t), 2 * t / (1 + t * t)
    zero, one = Fraction(0), Fraction(1)
    return (c, -s, zero), (s, c, zero), (zero, zero, one)


def _dot(a: Vector, b: Vector) -> Fraction:
    return sum((x * y for x, y in zip(a, b, strict=True)), start=Fraction(0))


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _difference(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]
