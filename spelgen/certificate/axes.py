"""Tests of geometric relations between joint axes at all configurations, and of the mass balance of the last body.

The results are the reasons for the structure of M and the potential energy V. A relation, such as parallel axes, is
tested in exact arithmetic at two random rational configurations. A relation that is false at some configurations passes
this test with a probability below 1e-9 (Schwartz 1980, Zippel 1979). The mass balance is the position of the centre of
mass and of the principal axes relative to the last joint axis (see `Axes`).
"""

import random
from fractions import Fraction

import numpy as np

from spelgen.arm.arm import Chain
from spelgen.arm.rational import IDENTITY, ZERO, turn_about
from spelgen.urdf.robot import Assume


def is_plain(arm: Chain) -> bool:
    """Return True for an arm without branches and mimic joints: its bodies form one chain, with a coordinate each."""
    for index, body in enumerate(arm.bodies):
        if body.parent != index - 1 or body.coordinate != index or body.multiplier != 1:
            return False
    return True


class Axes:
    """Tests of the joint axes of an arm without branches and mimic joints; joints are counted from 0.

    A test returns True if the relation is true at all configurations.

    Args:
        arm: the arm.
        assume: ``inertials``: the inertial parameters of the URDF are used. ``kinematics``: inertial parameters are
            unknown, and the four attributes about the last body are False.

    Attributes:
        centred: True if the centre of mass of the last body is on the axis of the last joint.
        balanced: True if the last body is dynamically balanced: the axis of the last joint is a principal axis of
            inertia through the centre of mass of the body.
        symmetric: True if the inertia of the last body, in the frame of its parent, does not depend on the position of
            the last joint.
        without_inertia: True if the last body has no moment of inertia about the axis of the last joint.
    """

    def __init__(self, arm: Chain, assume: Assume = "kinematics"):
        self.arm = arm
        self.prismatic = [joint_type == "prismatic" for joint_type in arm.joint_types]
        generator = random.Random(0)  # The seed is constant, so that reports are reproducible.
        # Two configurations suffice. A relation is a polynomial equation, of degree d, in the random numbers below 1e6
        # of a configuration. If it is not an identity, the random numbers of one configuration satisfy it by chance
        # with a probability of about d / 1e6.
        configurations = [_configuration(arm, generator) for _ in range(2)]
        # Unit vectors (2, n, 3) and twists (2, n, 6) of the axes of the n joints at the two random configurations, as
        # exact fractions.
        self._directions, self._twists = map(np.array, zip(*configurations, strict=True))
        # The four attributes of this class (`centred` to `without_inertia`) are tests of the inertial parameters of the
        # last body. They are true only if certain parameters are zero or equal. If the joint is not revolute, or if the
        # inertial parameters are unknown, all ten are set to 1: since none of them is zero, all four attributes are
        # then False.
        last = arm.bodies[-1]
        inertia: tuple[Fraction, ...] = (Fraction(1),) * 10
        if assume == "inertials" and last.inertia is not None and last.joint_type == "revolute":
            inertia = last.inertia
        _, hx, hy, _, xx, xy, xz, yy, yz, zz = inertia
        self.centred = not hx and not hy
        self.balanced = self.centred and not xz and not yz
        self.symmetric = self.balanced and xx == yy and not xy
        self.without_inertia = not zz

    def parallel(self, a: int, b: int) -> bool:
        return _are_parallel(self._directions[:, a], self._directions[:, b])

    def perpendicular(self, a: int, b: int) -> bool:
        return not self._cosines(a, b).any()

    def fixed_angle(self, a: int, b: int) -> bool:
        return len(set(self._cosines(a, b))) == 1

    def _cosines(self, a: int, b: int) -> np.ndarray:
        return np.asarray((self._directions[:, a] * self._directions[:, b]).sum(axis=-1))

    def opposed(self, a: int, b: int) -> bool:
        """Return True if the axes of joints ``a`` and ``b`` have opposite directions; the axes must be parallel."""
        # The cosine of the angle between unit vectors that are always parallel is 1 or -1 at all configurations.
        return bool((self._cosines(a, b) < 0).all())

    def same_twist(self, a: int, b: int) -> bool:
        """Return True if joints ``a`` and ``b`` have equal or opposite twists.

        This is true for coaxial revolute joints, and for parallel prismatic joints. A unit velocity of ``a`` and a unit
        velocity of ``b`` give equal or opposite velocities to a body that both joints carry.
        """
        return _are_parallel(self._twists[:, a], self._twists[:, b])

    def commute(self, a: int, b: int) -> bool:
        """Return True if the motions of joints ``a`` and ``b`` commute: the Lie bracket of their twists is zero."""
        v, w = np.split(self._twists[:, a], 2, axis=-1)
        v_b, w_b = np.split(self._twists[:, b], 2, axis=-1)
        return not np.cross(w, w_b).any() and not (np.cross(w, v_b) - np.cross(w_b, v)).any()

    def keep_offset(self, slider: int, hinge: int) -> bool:
        """Return True if all points that the prismatic joint ``slider`` carries keep their distances from a plane.

        The plane contains the axis of the revolute joint ``hinge``, which is nearer to the root; it is parallel to the
        axis of ``slider`` and moves with the child link of ``hinge``. Let d be the signed distance of a point from the
        plane, and a the angle between both axes. If only ``hinge`` moves, at 1 rad/s, the velocity of the point along
        ``slider`` is d sin(a). The entry (slider, hinge) of M is the sum of mass times d sin(a) over these points: it
        is constant if all d are constant, and zero for parallel axes.
        """
        # The plane must be fixed to the child link of `hinge`. A revolute joint between `hinge` and `slider` can turn
        # the axis of `slider`, and thereby the plane: for such an arm the relation is not tested, and the result is
        # False.
        if not all(self.prismatic[hinge + 1 : slider]):
            return False
        later = [joint for joint in range(hinge + 1, len(self.prismatic)) if joint != slider]
        normal = np.cross(self._directions[:, slider], self._directions[:, hinge])
        return all(_is_orthogonal(self._twists[:, joint], normal) for joint in later)

    def is_weightless(self, joint: int) -> bool:
        """Return True if a motion of ``joint`` does no work against gravity.

        The joint then slides horizontally, or rotates about a vertical axis, at all configurations.
        """
        return _is_orthogonal(self._twists[:, joint], np.array(self.arm.gravity))


def _configuration(arm: Chain, generator: random.Random) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return (axes, twists) of the n joints in the root frame at a random configuration, as exact fractions.

    axes: n unit vectors (3,). twists: n vectors (6,), for a unit velocity of the joint: linear velocity (3,) of the
    body's point at the origin of the root frame, then angular velocity (3,).
    """
    axes, twists = [], []
    # `numbers` is the range of random numerators and denominators of positions. In a larger range, a false relation is
    # less likely to be true by chance.
    numbers = range(1, 10**6)
    rotation, origin = IDENTITY, ZERO
    for body in arm.bodies:
        origin = origin + rotation @ np.array(body.translation)
        rotation = rotation @ np.array(body.rotation)
        axis = rotation[:, 2]
        axes.append(axis)
        t = Fraction(generator.choice(numbers), generator.choice(numbers))
        if body.joint_type == "prismatic":
            twists.append(np.concatenate([axis, ZERO]))
            origin = origin + t * axis
        else:
            twists.append(np.concatenate([np.cross(origin, axis), axis]))
            # t is the rational tangent of half the joint angle, so that its cosine and sine are rational.
            norm = 1 + t * t
            rotation = rotation @ turn_about(2, (1 - t * t) / norm, 2 * t / norm)
    return axes, twists


def _are_parallel(a: np.ndarray, b: np.ndarray) -> bool:
    """Return True if two vectors of fractions, (2, k) each, are exactly parallel at both configurations of `Axes`."""
    products = a[:, :, None] * b[:, None, :]
    return not (products - products.mT).any()


def _is_orthogonal(twist: np.ndarray, direction: np.ndarray) -> bool:
    """Return True if no point of a body has a velocity component along ``direction``, (2, 3), or (3,) if constant.

    direction: vector at each configuration of `Axes`, (2, 3), or a constant vector, (3,). twist: linear velocity, then
    angular velocity of the body, (2, 6): one row per configuration.
    """
    v, w = np.split(twist, 2, axis=-1)
    return not (v * direction).sum(axis=-1).any() and not np.cross(w, direction).any()
