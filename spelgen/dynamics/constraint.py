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
        leader, multiplier, shift = _followed(robot, name)
        offset[row] = shift
        if leader in columns:
            jacobian[row, columns[leader]] = multiplier
    return Constraint(tuple(moving), jacobian, offset)


def _followed(robot: Robot, name: str) -> tuple[str, float, float]:
    """What a joint follows in the end: leader, multiplier and offset."""
    multiplier, offset = 1.0, 0.0
    while (mimic := robot.joint[name].mimic) is not None:
        name, multiplier, offset = (
            mimic.joint,
            multiplier * mimic.multiplier,
            offset + multiplier * mimic.offset,
        )
    return name, multiplier, offset
