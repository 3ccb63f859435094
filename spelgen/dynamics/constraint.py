"""Mimic joints folded in: all joints of a robot stand at K q + offset, with q the coordinates of an arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spelgen.urdf.robot import Robot


@dataclass(frozen=True, eq=False)
class Constraint:
    """b joints that move with n coordinates: they stand at jacobian @ q + offset.

    names: of the joints. jacobian: K, (b, n). offset: (b,) [rad; m].
    """

    names: tuple[str, ...]
    jacobian: np.ndarray
    offset: np.ndarray


def mimic_constraint(robot: Robot, coordinates: Sequence[str]) -> Constraint:
    """All moving joints of ``robot``: the coordinates, what follows them, and the others locked at 0."""
    columns = {name: k for k, name in enumerate(coordinates)}
    moving = [joint.name for joint in robot.joints if joint.moves]
    jacobian, offset = np.zeros((len(moving), len(columns))), np.zeros(len(moving))
    for row, name in enumerate(moving):
        # what a joint follows in the end
        multiplier, leader = 1.0, name
        while (mimic := robot.joint[leader].mimic) is not None:
            offset[row] += multiplier * mimic.offset
            multiplier *= mimic.multiplier
            leader = mimic.joint
        if leader in columns:
            jacobian[row, columns[leader]] = multiplier
    return Constraint(tuple(moving), jacobian, offset)
