"""Mimic joints: the positions of all joints of a robot are K q + offset, with q the coordinates of an arm."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spelgen.urdf.robot import Robot


@dataclass(frozen=True, eq=False)
class Constraint:
    """Positions of b joints as a function of n coordinates: jacobian @ q + offset.

    names: of the joints. jacobian: K, (b, n). offset: (b,) [rad, m].
    """

    names: tuple[str, ...]
    jacobian: np.ndarray
    offset: np.ndarray


def mimic_constraint(robot: Robot, coordinates: Sequence[str]) -> Constraint:
    """Return the constraint of all joints of ``robot``: coordinates, mimic joints, and locked joints (0)."""
    columns = {name: k for k, name in enumerate(coordinates)}
    moving = [joint.name for joint in robot.joints if joint.moves]
    jacobian, offset = np.zeros((len(moving), len(columns))), np.zeros(len(moving))
    for row, name in enumerate(moving):
        # the leader at the end of a chain of mimic joints
        multiplier, leader = 1.0, name
        while (mimic := robot.joint[leader].mimic) is not None:
            offset[row] += multiplier * mimic.offset
            multiplier *= mimic.multiplier
            leader = mimic.joint
        # a locked joint keeps a row of zeros: it stays at zero
        if leader in columns:
            jacobian[row, columns[leader]] = multiplier
    return Constraint(tuple(moving), jacobian, offset)
