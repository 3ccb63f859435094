"""Mimic joints as a linear function: joint positions = K q + offset, with the coordinates q of an arm."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spelgen.urdf.robot import Robot


@dataclass(frozen=True, eq=False)
class Constraint:
    """Positions of b joints, mimic joints included, as a function K q + offset of n coordinates q.

    Attributes:
        names: names of the b joints.
        jacobian: matrix K, (b, n): the multipliers of mimic joints, and 1 for a joint that is a coordinate.
        offset: joint positions at q = 0, (b,) [rad, m].
    """

    names: tuple[str, ...]
    jacobian: np.ndarray
    offset: np.ndarray


def mimic_constraint(robot: Robot, coordinates: Sequence[str]) -> Constraint:
    """Return the positions of all moving joints of ``robot`` as a function of the coordinates q.

    coordinates: names of the joints that are coordinates, in the order of q. A mimic joint of a coordinate moves with
    it; all other joints are locked at zero.
    """
    columns = {name: k for k, name in enumerate(coordinates)}
    moving = [joint.name for joint in robot.joints if joint.moves]
    jacobian, offset = np.zeros((len(moving), len(columns))), np.zeros(len(moving))
    for row, name in enumerate(moving):
        # A mimic joint may mimic another mimic joint: find the coordinate at the end of the chain of mimic joints.
        multiplier, leader = 1.0, name
        while (mimic := robot.joint[leader].mimic) is not None:
            offset[row] += multiplier * mimic.offset
            multiplier *= mimic.multiplier
            leader = mimic.joint
        # The row of a locked joint in `jacobian` is zero, so its position is constant.
        if leader in columns:
            jacobian[row, columns[leader]] = multiplier
    return Constraint(tuple(moving), jacobian, offset)
