"""Find how the axes of an arm's joints lie to each other however it moves, and how the last body is balanced.

"Always" is tested exactly, at random rational configurations: a relation that does not always hold fails at
one of them but for odds below 1e-9 (Schwartz 1980, Zippel 1979).
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from fractions import Fraction
from functools import cached_property

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.arm.rational import IDENTITY, ZERO, turn_about

_CONFIGURATIONS = 2
_GRID = 10**6


def is_plain(arm: Arm) -> bool:
    """Whether the bodies are one chain, each with a coordinate of its own."""
    for index, body in enumerate(arm.bodies):
        if body.parent != index - 1 or body.coordinate != index or body.multiplier != 1:
            return False
    return True


class Axes:
    """Answer whether something holds of the axes of a plain arm's joints at every configuration."""

    def __init__(self, arm: Arm):
        self.arm = arm
        self.slides = [kind == "prismatic" for kind in arm.joint_types]
        # fixed, so that a report is the same every time
        generator = random.Random(0)
        # directions and twists of the axes, (joints, 3) and (joints, 6), by configuration
        self._configurations = [_configuration(arm, generator) for _ in range(_CONFIGURATIONS)]

    def parallel(self, a: int, b: int) -> bool:
        return all(_are_parallel(axes[a], axes[b]) for axes, _ in self._configurations)

    def perpendicular(self, a: int, b: int) -> bool:
        return self._cosines(a, b) == {0}

    def fixed_angle(self, a: int, b: int) -> bool:
        return len(self._cosines(a, b)) == 1

    def _cosines(self, a: int, b: int) -> set[Fraction]:
        return {axes[a] @ axes[b] for axes, _ in self._configurations}

    def opposed(self, a: int, b: int) -> bool:
        """Whether the two point against each other, for axes that are always parallel."""
        # parallel unit vectors have a cosine of 1 or -1, at every configuration the same
        return max(self._cosines(a, b)) < 0

    def move_alike(self, a: int, b: int) -> bool:
        """Whether unit rates of the two joints give the same velocity field, or opposite ones."""
        return all(_are_parallel(twists[a], twists[b]) for _, twists in self._configurations)

    def commute(self, a: int, b: int) -> bool:
        """Whether moving one joint leaves the other's axis where it was: the twists' Lie bracket is zero."""
        for _, twists in self._configurations:
            (v, w), (v_b, w_b) = np.split(twists[a], 2), np.split(twists[b], 2)
            if np.cross(w, w_b).any() or (np.cross(w, v_b) - np.cross(w_b, v)).any():
                return False
        return True

    def keep_offset(self, slider: int, turner: int) -> bool:
        """Whether no joint moves the mass behind ``slider`` across the plane of the two directions."""
        if not all(self.slides[turner + 1 : slider]):
            return False  # a turn between the two may turn the plane
        later = [joint for joint in range(turner + 1, len(self.slides)) if joint != slider]
        for axes, twists in self._configurations:
            normal = np.cross(axes[slider], axes[turner])
            if not all(_moves_nothing(twists[joint], normal) for joint in later):
                return False
        return True

    @cached_property
    def centred(self) -> bool:
        """Whether the centre of mass of the last body, as the URDF has it, lies on its joint's axis."""
        return not any(self._last_inertia[1:3])

    @cached_property
    def balanced(self) -> bool:
        """Whether the last joint's axis also is a principal axis of inertia: it turns without shaking."""
        xz, yz = self._last_inertia[6], self._last_inertia[8]
        return self.centred and not xz and not yz

    @cached_property
    def symmetric(self) -> bool:
        """Whether the last body has the same inertia however its joint turns."""
        xx, xy, yy = self._last_inertia[4], self._last_inertia[5], self._last_inertia[7]
        return self.balanced and xx == yy and not xy

    @cached_property
    def without_inertia(self) -> bool:
        """Whether it has no moment of inertia about the last joint's axis."""
        return not self._last_inertia[9]

    @cached_property
    def _last_inertia(self) -> Sequence[Fraction]:
        body = self.arm.bodies[-1]
        if body.inertia is not None and body.kind == "revolute":
            return body.inertia
        # of a body that slides nothing here is said: these ones are neither centred nor balanced
        return (Fraction(1),) * 10

    def lifts_nothing(self, joint: int) -> bool:
        """Whether the joint slides level, or turns about the vertical."""
        gravity = np.array(self.arm.gravity)
        return all(_moves_nothing(twists[joint], gravity) for _, twists in self._configurations)


def _configuration(arm: Arm, generator: random.Random) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return axes and twists of a plain arm's joints, in the root's frame, at a random rational configuration.

    A twist is how a unit rate moves a body: the velocity of its point at the root's origin, then its angular velocity.
    """
    axes, twists = [], []
    rotation, origin = IDENTITY, ZERO
    for body in arm.bodies:
        origin = origin + rotation @ np.array(body.translation)
        rotation = rotation @ np.array(body.rotation)
        axis = rotation[:, 2]
        axes.append(axis)
        t = Fraction(generator.randrange(1, _GRID), generator.randrange(1, _GRID))
        if body.kind == "prismatic":
            twists.append(np.concatenate([axis, ZERO]))
            origin = origin + t * axis
        else:
            twists.append(np.concatenate([np.cross(origin, axis), axis]))
            # t is the tangent of half the angle: so cosine and sine are rational too
            norm = 1 + t * t
            rotation = rotation @ turn_about(2, (1 - t * t) / norm, 2 * t / norm)
    return axes, twists


def _are_parallel(a: np.ndarray, b: np.ndarray) -> bool:
    products = np.outer(a, b)
    return not (products - products.T).any()


def _moves_nothing(twist: np.ndarray, direction: np.ndarray) -> bool:
    """Whether a joint moves no point of a body along the direction."""
    v, w = np.split(twist, 2)
    return not v @ direction and not np.cross(w, direction).any()
