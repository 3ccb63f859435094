"""Mimic joints as a linear constraint: joint positions = K q + offset, with the coordinates q of an arm."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spelgen.urdf.robot import Robot


@dataclass(frozen=True, eq=False)
class Constraint:
    """Positions of b joints as a function of n coordinates: jacobian @ q + offset.

    Attributes:
        names: names of the b joints.
        jacobian: matrix K, (b, n).
        offset: joint positions at q = 0, (b,) [rad, m].
    """

    names: tuple[str, ...]
    jacobian: np.ndarray
    offset: np.ndarray


def mimic_constraint(robot: Robot, coordinates: Sequence[str]) -> Constraint:
    """Return the constraint of all joints of ``robot``.

    coordinates: names of the joints that are coordinates. All other joints are mimic joints, or locked at zero.
    """
    columns = {name: k for k, name in enumerate(coordinates)}
    moving = [joint.name for joint in robot.joints if joint.moves]
    jacobian, offset = np.zeros((len(moving), len(columns))), np.zeros(len(moving))
    for row, name in enumerate(moving):
        # A mimic joint may follow another mimic joint: find the coordinate at the end of the chain.
        multiplier, leader = 1.0, name
        while (mimic := robot.joint[leader].mimic) is not None:
            offset[row] += multiplier * mimic.offset
            multiplier *= mimic.multiplier
            leader = mimic.joint
        # The row of a locked joint is zero, so its position is zero.
        if leader in columns:
            jacobian[row, columns[leader]] = multiplier
    return Constraint(tuple(moving), jacobian, offset)
